# SPDX-License-Identifier: Apache-2.0
"""The mirrored world: what is mirrored, and how depth of it is fused with the usual one."""

import numpy as np
import pytest
import torch

from cvcdepth_core.engines.example_rigs import ring_of_cameras, ring_of_pictures
from cvcdepth_core.networks.mirroring import fuse_flipped, fuse_with_mirrored, mirror, mirror_rig, mirrored_pictures


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_mirroring_touches_only_the_samples_the_coin_names():
    images = torch.rand(3, 2, 3, 4, 5)
    mirrored = mirror(images, torch.tensor([True, False, True]))
    assert torch.equal(mirrored[0], images[0].flip(-1))
    assert torch.equal(mirrored[1], images[1])
    assert torch.equal(mirrored[2], images[2].flip(-1))


def test_the_mirrored_rig_sees_the_mirrored_world():
    """A point on one side is seen where its mirror image on the other side is seen in the mirrored picture."""
    rig = ring_of_cameras(64, 96).to(dtype=torch.float64)
    intrinsics = rig.intrinsics.clone()
    intrinsics[..., 0, 1], intrinsics[..., 0, 2] = 0.7, 30.0  # a skew, and a principal point aside
    rig = rig._replace(intrinsics=intrinsics)
    mirrored = mirror_rig(rig, torch.tensor([True]))
    points = 10 * torch.randn(200, 3, generator=generator(), dtype=torch.float64)
    other_side = points * points.new_tensor([1.0, -1.0, 1.0])
    for camera in range(6):
        pixels, depth = project(points, rig, camera)
        seen, seen_depth = project(other_side, mirrored, camera)
        torch.testing.assert_close(seen_depth, depth)
        torch.testing.assert_close(seen[:, 0], 95 - pixels[:, 0])
        torch.testing.assert_close(seen[:, 1], pixels[:, 1])


def project(points: torch.Tensor, rig, camera: int) -> tuple[torch.Tensor, torch.Tensor]:
    camera_T_base = torch.linalg.inv(rig.base_T_camera[0, camera])
    in_camera = points @ camera_T_base[:3, :3].T + camera_T_base[:3, 3]
    x, y, z = (in_camera @ rig.intrinsics[0, camera].T).T
    return torch.stack([x / z, y / z], dim=1), z


def test_the_mirrored_rig_could_be_built_and_mirrored_back_is_the_rig():
    rig = ring_of_cameras(64, 96).to(dtype=torch.float64)
    rig = rig._replace(masks=torch.rand(rig.masks.shape, generator=generator(), dtype=torch.float64))
    both = rig._replace(**{name: torch.cat([part, part]) for name, part in rig._asdict().items()})
    flips = torch.tensor([True, False])
    mirrored = mirror_rig(both, flips)
    torch.testing.assert_close(torch.linalg.det(mirrored.base_T_camera[..., :3, :3]), torch.ones(2, 6).double())
    assert torch.equal(mirrored.images[0], rig.images[0].flip(-1))
    assert torch.equal(mirrored.masks[0], rig.masks[0].flip(-1))
    for one, back, plain in zip(mirrored, mirror_rig(mirrored, flips), both, strict=True):
        assert torch.equal(one[1], plain[1])
        torch.testing.assert_close(back, plain)


def test_a_mirrored_set_mirrored_again_is_the_set():
    plain = ring_of_pictures(32, 48, present=5)
    once = mirrored_pictures(plain)
    np.testing.assert_array_equal(once.pictures, plain.pictures[:, :, ::-1])
    np.testing.assert_array_equal(once.valid, plain.valid[:, :, ::-1])
    np.testing.assert_allclose(once.base_T_camera[:, 1, 3], -plain.base_T_camera[:, 1, 3])
    twice = mirrored_pictures(once)
    for name, value in vars(plain).items():
        np.testing.assert_allclose(getattr(twice, name), value, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(("fusion", "middle"), [("none", 2.0), ("depth", 5.0), ("inverse_depth", 3.2)])
def test_in_the_middle_both_count_and_each_alone_at_its_border(fusion, middle):
    fused = fuse_with_mirrored(torch.full((1, 4, 100), 2.0), torch.full((1, 4, 100), 8.0), fusion)
    torch.testing.assert_close(fused[0, :, 50], torch.full((4,), middle))
    if fusion != "none":
        torch.testing.assert_close(fused[0, :, 0], torch.full((4,), 8.0))
        torch.testing.assert_close(fused[0, :, -1], torch.full((4,), 2.0))


def test_depth_of_the_mirrored_world_is_mirrored_back_before_it_is_fused():
    depth = 1 + torch.rand(2, 5, 40, generator=generator())
    torch.testing.assert_close(fuse_with_mirrored(depth, depth.flip(-1), "depth"), depth)
    torch.testing.assert_close(fuse_flipped(depth, depth), depth)
