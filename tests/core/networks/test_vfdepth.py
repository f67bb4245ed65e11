# SPDX-License-Identifier: Apache-2.0
"""VFDepth on any rig: what holds of its volume and its depth, whatever the weights are."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from cvcdepth_core.errors import CheckpointError, RigError
from cvcdepth_core.networks import DepthModelSpec, RigImages, build_depth_network
from cvcdepth_core.networks.checkpoint import import_released, load_checkpoint, save_checkpoint
from cvcdepth_core.networks.mirroring import mirror_rig
from cvcdepth_core.networks.vfdepth import DEPTH_NAMES, POSE_NAMES, FusedDepthNet, VolumePoseNet, VoxelFusion, renamed
from cvcdepth_core.networks.volume import (
    VolumeSpec,
    feature_size,
    fusion_geometry,
    refuse_cameras_outside,
    ring_of,
    voxel_views,
)
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.starting_model import build_surround_model

HEIGHT, WIDTH = 64, 96
VOLUME = VolumeSpec(
    voxels=(12, 12, 4),
    voxel_size=(2, 2, 1.5),
    first_voxel=(-11, -11, -1),
    nearest=1,
    farthest=10,
    steps=6,
    image_channels=8,
    voxel_channels=6,
)
SPEC = DepthModelSpec(
    network="vfdepth",
    encoder="efficientnet_lite0",
    height=HEIGHT,
    width=WIDTH,
    min_depth=0.5,
    max_depth=50,
    volume=VOLUME.model_dump(),
)


def ring_rig(cameras: int, field_of_view: float = 0.0, samples: int = 1) -> RigImages:
    """Cameras that look outwards, the first ahead, each overlapping its neighbours by 20 degrees or as told."""
    generator = torch.Generator().manual_seed(cameras)
    focal = WIDTH / 2 / math.tan(math.radians(min(field_of_view or 360 / cameras + 20, 130)) / 2)
    intrinsics = torch.tensor([[focal, 0, WIDTH / 2 - 3], [0, focal, HEIGHT / 2 + 2], [0, 0, 1]])
    yaw = 2 * math.pi * torch.arange(cameras) / cameras
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    right, down, ahead = (
        torch.stack(axis, dim=-1)
        for axis in ((yaw.sin(), -yaw.cos(), zero), (zero, zero, -one), (yaw.cos(), yaw.sin(), zero))
    )
    mounts = torch.eye(4).repeat(cameras, 1, 1)
    mounts[:, :3] = torch.stack([right, down, ahead, 0.5 * ahead + torch.tensor([0, 0, 1.4])], dim=-1)
    images = torch.rand(samples, cameras, 3, HEIGHT, WIDTH, generator=generator)
    present = torch.ones(samples, cameras, dtype=torch.bool)
    masks = torch.ones_like(images[:, :, :1])
    masks[..., HEIGHT - 6 :, :30] = 0
    rig = RigImages(
        images, intrinsics.expand(samples, cameras, 3, 3), mounts.expand(samples, cameras, 4, 4), present, masks
    )
    return rig.to(dtype=torch.float64)


def lively(network: torch.nn.Module) -> torch.nn.Module:
    """Larger weights behind the encoder, so that every camera matters."""
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "encoder" not in name and parameter.ndim > 1:
                parameter.mul_(3.0)
    return network.double().eval()


@pytest.fixture(scope="module")
def network() -> FusedDepthNet:
    torch.manual_seed(1)
    return lively(build_depth_network(SPEC))


def apart(ours: Tensor, expected: Tensor) -> float:
    return float((ours - expected).detach().abs().max())


@torch.inference_mode()
@pytest.mark.parametrize("cameras", [1, 2, 3, 4, 5, 6, 7])
def test_any_number_of_cameras_in_any_order(network, cameras):
    rig = ring_rig(cameras)
    disparity = network(rig)
    assert disparity.shape == (1, cameras, 1, HEIGHT, WIDTH)
    assert float(disparity.std()) > 0.01
    order = torch.randperm(cameras, generator=torch.Generator().manual_seed(2)).tolist()
    assert apart(network(rig.of_cameras(order)), disparity[:, order]) < 1e-12


@torch.inference_mode()
def test_the_neighbours_of_a_camera_see_its_picture_and_the_one_behind_it_does_not(network):
    rig = ring_rig(4)
    other = rig.images.clone()
    other[:, 1] = 1 - other[:, 1]
    changed = (network(rig._replace(images=other)) - network(rig)).abs().amax((0, 2, 3, 4))
    assert float(changed[:3].min()) > 1e-6
    assert float(changed[3]) == 0


@torch.inference_mode()
def test_samples_of_a_batch_do_not_know_of_each_other(network):
    rig = ring_rig(5, samples=2)
    poses, seen = rig.base_T_camera.clone(), rig.present.clone()
    poses[1, :, 2, 3] += 0.4
    seen[1, 2] = False
    rig = rig._replace(base_T_camera=poses, present=seen)
    both = network(rig)
    for sample in (0, 1):
        alone = network(RigImages(*(part[sample : sample + 1] for part in rig)))
        assert apart(alone, both[sample : sample + 1]) < 1e-12


@torch.inference_mode()
def test_a_dead_camera_a_hidden_one_and_one_that_is_not_there_are_the_same_for_the_others(network):
    rig, living = ring_rig(6), [0, 1, 2, 4, 5]  # 3 looks back
    dead, masks = rig.present.clone(), rig.masks.clone()
    dead[:, 3] = False
    masks[:, 3] = 0
    without = network(rig.of_cameras(living))
    assert apart(network(rig._replace(present=dead))[:, living], without) < 1e-12
    assert apart(network(rig._replace(masks=masks))[:, living], without) < 1e-12
    assert apart(network(rig)[:, living], without) > 1e-6


@torch.inference_mode()
def test_without_any_picture_and_far_outside_of_the_volume_depth_stays_finite(network):
    rig = ring_rig(4)
    far = rig.base_T_camera.clone()
    far[:, 1, 0, 3] = 500
    nobody = torch.zeros_like(rig.present)
    for changed in (rig._replace(base_T_camera=far), rig._replace(present=nobody)):
        assert network(changed).isfinite().all()


def test_equal_features_make_equal_voxels_but_for_their_depth():
    rig = ring_rig(4)
    fusion = VoxelFusion(8, 6).double()
    with torch.no_grad():
        for layer in (fusion.alone, fusion.overlap):
            layer.weight[:, 8::9] = 0
    geometry = fusion_geometry(VOLUME, voxel_views(VOLUME, rig), ring_of(rig.base_T_camera), feature_size(rig.images))
    features = torch.linspace(-1, 1, 8).double()[:, None, None].expand(4, 8, 8, 12)
    voxels = fusion(features, geometry)
    for views in (0, 1, 2):
        alike = voxels[geometry.views == views]
        assert len(alike) > 10
        assert apart(alike, alike[:1]) < 1e-12
    assert not voxels[geometry.views == 0].any()


@pytest.mark.parametrize(
    ("cameras", "slots"), [(6, [0, 1, 0, 1, 0, 1]), (3, [0, 1, 1]), (5, [0, 1, 0, 0, 1]), (2, [0, 1])]
)
def test_neighbours_take_turns_along_the_ring_from_the_camera_ahead(cameras, slots):
    assert ring_of(ring_rig(cameras).base_T_camera).slots.tolist() == [slots]


@torch.inference_mode()
def test_only_the_corrected_volume_tells_alike_neighbours_apart_and_fills_what_three_cameras_see():
    rig = ring_rig(3, field_of_view=130).of_cameras([0, 1, 2, 1])
    corrected = VOLUME.model_copy(update={"corrected": True})
    views, ring, size = voxel_views(VOLUME, rig), ring_of(rig.base_T_camera), feature_size(rig.images)
    filled = {volume.corrected: fusion_geometry(volume, views, ring, size) for volume in (VOLUME, corrected)}
    three = filled[False].views >= 3
    assert three.any()
    assert not filled[False].filled[three].any()
    assert filled[True].filled[three].all()
    two_alike = (views.seen & (ring.slots == 1)[..., None]).sum(1).flatten() == 2
    alike = two_alike & (filled[False].views == 2)
    assert alike.any()
    kinds = [(geometry.sums.rows % 3)[alike] for geometry in filled.values()]
    assert (kinds[0] == 2)[filled[False].sums.weights[alike] > 0].all()
    assert sorted(set(kinds[1][filled[True].sums.weights[alike] > 0].tolist())) == [1, 2]


@torch.inference_mode()
def test_the_corrected_volume_is_the_published_one_where_two_cameras_at_most_see_a_voxel(network):
    rig = ring_rig(6)
    corrected = SPEC.model_copy(update={"volume": VOLUME.model_copy(update={"corrected": True})})
    other = build_depth_network(corrected).double().eval()
    other.load_state_dict(network.state_dict())
    assert int(network.geometry(rig).fusion.views.max()) == 2
    assert apart(other(rig), network(rig)) < 1e-12
    assert other.engines == ("torch_eager",)  # an exported one has a number of cameras for each voxel


@torch.inference_mode()
def test_a_camera_turned_to_its_neighbours_place_sees_what_the_neighbour_sees(network):
    rig = ring_rig(6)
    own, novel = network.with_novel_views(rig, rig.base_T_camera.roll(-1, dims=1))
    assert apart(own, network(rig)) < 1e-12
    assert apart(novel, own.roll(-1, dims=1)) < 1e-12


def test_the_mirrored_world_has_the_mirrored_volume():
    rig = ring_rig(5)
    mirrored = mirror_rig(rig, torch.tensor([True]), FusedDepthNet.mirror_offset)
    fusion, size = VoxelFusion(8, 6).double(), feature_size(rig.images)
    features = torch.randn(5, 8, *size, dtype=torch.float64)
    found = []
    for seen, maps in ((rig, features), (mirrored, features.flip(-1))):
        seen = seen._replace(masks=torch.ones_like(seen.masks))
        geometry = fusion_geometry(VOLUME, voxel_views(VOLUME, seen), ring_of(seen.base_T_camera), size)
        found.append(fusion(maps, geometry).view(4, 12, 12, 6))
    assert apart(found[1].flip(1), found[0]) < 1e-6  # the grid is the same to the left and to the right


# --- specs, checkpoints, released weights


def test_training_does_not_start_from_weights_of_another_volume(network, tmp_path):
    path = tmp_path / "fused.safetensors"
    save_checkpoint(path, SPEC, network.state_dict())
    other = SPEC.model_copy(update={"volume": VOLUME.model_copy(update={"farthest": 30.0})})
    with pytest.raises(CheckpointError, match=r"volume is .*farthest=10.0.* depth.volume is .*farthest=30.0"):
        build_surround_model(TrainingConfig(depth=other), load_checkpoint(path))


def test_a_checkpoint_carries_the_volume_and_gives_the_same_depth(network, tmp_path):
    path = tmp_path / "fused.safetensors"
    save_checkpoint(path, SPEC, network.state_dict())
    loaded = load_checkpoint(path)
    assert loaded.spec == SPEC
    assert loaded.spec.volume == VOLUME
    rig = ring_rig(3)
    with torch.inference_mode():
        assert apart(loaded.build_depth_net().double()(rig), network(rig)) < 1e-6


def test_a_volume_is_the_published_one_where_none_is_given_and_refused_for_other_networks():
    sizes = {"height": HEIGHT, "width": WIDTH, "min_depth": 1, "max_depth": 50}
    assert DepthModelSpec(network="vfdepth", **sizes).volume == VolumeSpec()
    with pytest.raises(ValueError, match="volume is given, but the network per_camera has none"):
        DepthModelSpec(volume=VOLUME, **sizes)
    assert "volume" not in DepthModelSpec(**sizes).model_dump()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voxels": (1, 12, 4)}, r"voxels \(1, 12, 4\) of"),
        ({"nearest": 10.0}, "nearest 10.0 must be below farthest 10.0"),
    ],
)
def test_a_volume_without_extent_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        VolumeSpec(**VOLUME.model_dump() | change)


def test_a_camera_outside_of_the_volume_is_refused_with_place_and_extent():
    mounts = ring_rig(3).base_T_camera[0].numpy()
    refuse_cameras_outside(VOLUME, mounts, ["a", "b", "c"])
    mounts = mounts + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 9.0], [0, 0, 0, 0]])
    with pytest.raises(RigError, match=r"camera a: is at \(0.50, 0.00, 10.40\) m .* z -1 to 3.5"):
        refuse_cameras_outside(VOLUME, mounts, ["a", "b", "c"])


@pytest.fixture
def released(tmp_path):
    torch.manual_seed(5)
    for name, network, names in (
        ("depth_net", build_depth_network(SPEC), DEPTH_NAMES),
        ("pose_net", VolumePoseNet(SPEC.encoder, VOLUME), POSE_NAMES),
    ):
        state = renamed(network.state_dict(), {ours: theirs for theirs, ours in names.items()})
        torch.save({f"module.{key}": value for key, value in state.items()}, tmp_path / f"{name}.pth")
    return tmp_path


def test_released_weights_are_imported_with_and_without_the_prefix_of_several_processes(released):
    imported = import_released(released, SPEC)
    for name in ("depth_net", "pose_net"):
        state = torch.load(released / f"{name}.pth")
        torch.save({key.removeprefix("module."): value for key, value in state.items()}, released / f"{name}.pth")
    again = import_released(released, SPEC)
    assert imported.depth_net.keys() == build_depth_network(SPEC).state_dict().keys()
    for one, other in ((imported.depth_net, again.depth_net), (imported.pose_net, again.pose_net)):
        assert all(torch.equal(value, other[key]) for key, value in one.items())


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("depth_net", {"module.fusion_net.extra": torch.zeros(1)}, "unexpected fusion_net.extra"),
        (
            "pose_net",
            {"module.conv1x1.0.bias": torch.zeros(3)},
            r"pose_net.pth: .*misshapen aggregation.conv.bias is \[3\]",
        ),
    ],
)
def test_released_weights_that_do_not_fit_are_refused_by_name(released, part, change, message):
    torch.save(torch.load(released / f"{part}.pth") | change, released / f"{part}.pth")
    with pytest.raises(CheckpointError, match=message):
        import_released(released, SPEC)
