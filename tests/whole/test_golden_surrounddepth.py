# SPDX-License-Identifier: Apache-2.0
"""Equality with SurroundDepth's published program: families a to d and j of golden_surrounddepth/README.md.

The transformers at every level, the depth network in both layouts of its tokens, joint and separate poses, and how the
vehicle's motion becomes that of each camera. Its own objective, its points and its evaluation (families e to i) are not
built yet.
"""

from pathlib import Path
from typing import ClassVar

import pytest
import torch
from golden_arrays import GoldenArrays, assert_equal, weight
from torch import Tensor, nn

from cvcdepth_core.networks import PoseNet, RigImages
from cvcdepth_core.networks.cross_view import (
    DECODER_NAMES,
    LEVELS,
    CrossViewDepthNet,
    CrossViewSpec,
    CrossViewTransformer,
    sine_positions,
)
from cvcdepth_core.networks.vfdepth import renamed
from cvcdepth_core.training.motion import distribute_vehicle_motion, motion_to_context

BUILT = "abcdj"
GRADIENT, FLOAT32, SINGULAR_AXIS = 1e-8, 1e-4, 2e-7
RELEASED = CrossViewSpec(scales=4, released_layout=True)
CONTEXTS = ("m1", "p1")


class Golden(GoldenArrays):
    unseen: ClassVar[dict[str, set[str]]] = {}


def golden_directory(config: pytest.Config) -> Path:
    directory = config.getoption("--golden-surrounddepth-dir")
    assert directory.is_dir(), f"--golden-surrounddepth-dir {directory} is no directory"
    return directory


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test takes every file whose name begins as it says itself; `path` is one of them."""
    if "path" not in metafunc.fixturenames:
        return
    beginning = metafunc.function.__name__.removeprefix("test_").split("_of_")[0]
    files = sorted(golden_directory(metafunc.config).glob(f"{beginning}*.npz"))
    metafunc.parametrize("path", files, ids=[path.stem for path in files])


def released_names(level: int | None = None) -> dict[str, str]:
    """Ours for theirs; of one transformer alone where a level is given."""
    if level is None:
        return {**DECODER_NAMES, "encoder.": "depth_encoder.encoder."}
    theirs, ours = f"decoder_cross.{level}.", f"fusion.{level}."
    return {a.removeprefix(theirs): b.removeprefix(ours) for a, b in DECODER_NAMES.items() if a.startswith(theirs)}


def by_rule(network: nn.Module, seed: int, ours: dict[str, str]) -> None:
    """Fill a network by the rule of the README; `ours` has the program's file and key before each of our beginnings."""
    theirs = renamed(network.state_dict(), ours)
    back = {released: mine for mine, released in ours.items()}
    network.load_state_dict(renamed({key: weight(key, like, seed) for key, like in theirs.items()}, back))


def transformer(golden: Golden, spec: CrossViewSpec = RELEASED) -> CrossViewTransformer:
    level = int(golden["in_level"])
    channels = (64, 64, 128, 256, 512)[level]
    made = CrossViewTransformer(channels, level, spec).double()
    names = released_names(level)
    by_rule(made, int(golden["in_weight_seed"]), {b: f"depth.decoder_cross.{level}.{a}" for a, b in names.items()})
    return made


def everyone(features: Tensor) -> Tensor:
    return torch.ones(features.shape[:2], dtype=torch.bool)


def test_a_cvt_level_of_one_transformer(path):
    golden = Golden(path)
    made, x = transformer(golden), golden.tensor("in_x").div(32).requires_grad_()
    found: dict[str, Tensor] = {}
    for name in (
        "down",
        *(f"blocks.{i}" for i in range(8)),
        *(f"blocks.0.attention.{i}" for i in ("query", "key", "value", "answer")),
    ):
        made.get_submodule(name).register_forward_hook(lambda *call, name=name: found.update({name: call[-1]}))
    answer = made(x, everyone(x))
    assert_equal(answer, golden["out_residual"])
    assert_equal(found["down"], golden["out_down"])
    assert_equal(sine_positions(found["down"]), golden["out_positions"])
    query, key = (
        found[f"blocks.0.attention.{name}"].unflatten(-1, (8, -1)).transpose(1, 2) for name in ("query", "key")
    )
    attention = (query @ key.mT / query.shape[-1] ** 0.5).softmax(-1)
    for name, ours in {
        "q_block_0": found["blocks.0.attention.query"],
        "k_block_0": found["blocks.0.attention.key"],
        "v_block_0": found["blocks.0.attention.value"],
        "attention_block_0": attention,
        "attended_block_0": found["blocks.0.attention.answer"],
        **{f"block_{i}": found[f"blocks.{i}"] for i in range(8)},
    }.items():
        if f"out_{name}" in golden:
            assert_equal(ours, golden[f"out_{name}"])
    (answer * golden.tensor("in_cotangent") / 32).sum().backward()
    assert_equal(x.grad, golden["out_grad_x"], GRADIENT)
    parameters = renamed(
        dict(made.named_parameters()), {b: a for a, b in released_names(int(golden["in_level"])).items()}
    )
    for name in golden.names("out_grad_"):
        if name != "out_grad_x":
            assert_equal(parameters[name.removeprefix("out_grad_")].grad, golden[name], GRADIENT)


def test_a_cvt_cameras_of_any_number(path):
    golden = Golden(path)
    made = transformer(golden)
    for name in golden.names("in_x_"):
        x = golden.tensor(name) / 32
        with torch.no_grad():
            assert_equal(made(x, everyone(x)), golden[name.replace("in_x", "out_residual")])


def test_j_corrected_cvt_of_tokens_that_stay_where_they_are(path):
    golden, released = Golden(path), Golden(path.with_name(path.name.replace("j_corrected_", "a_")))
    made = transformer(golden, RELEASED.model_copy(update={"released_layout": False}))
    x = released.tensor("in_x").div(32).requires_grad_()
    answer = made(x, everyone(x))
    assert_equal(answer, golden["out_residual"])
    (answer * released.tensor("in_cotangent") / 32).sum().backward()
    assert_equal(x.grad, golden["out_grad_x"], GRADIENT)


def depth_network(
    golden: Golden, name: str, spec: CrossViewSpec, dtype: torch.dtype = torch.float64
) -> CrossViewDepthNet:
    network = CrossViewDepthNet("resnet34" if "resnet34" in name else "resnet18", spec).to(dtype)
    ours = {b: f"depth.{a}" for a, b in DECODER_NAMES.items()} | {"depth_encoder.encoder.": "encoder.encoder."}
    by_rule(network, int(golden["in_weight_seed"]), ours)
    return network.eval()


def rig_of(images: Tensor) -> RigImages:
    """Images [B * 6, ...] as rigs; the network looks at nothing else."""
    images = images.unflatten(0, (-1, 6))
    none = images.new_zeros(())
    return RigImages(images, none, none, everyone(images), none)


@pytest.mark.parametrize("mode", ["eval", "train"])
def test_b_depth_net_of_all_cameras(path, mode):
    golden = Golden(path)
    dtype = torch.float32 if path.stem.endswith("float32") else torch.float64
    tolerance = FLOAT32 if dtype == torch.float32 else 1e-9
    if mode == "train" and "out_disp_0_train" not in golden:
        return
    network = depth_network(golden, path.stem, RELEASED.model_copy(update={"added": "noskip" not in path.stem}), dtype)
    network.train(mode == "train")
    images = (golden.tensor("in_image") / 255).to(dtype).requires_grad_()
    rig = rig_of(images)
    disparities = [one.flatten(0, 1) for one in network.pyramid(rig)]
    for scale, disparity in enumerate(disparities):
        rows = disparity[[0, 6]] if mode == "train" else disparity
        assert_equal(rows, golden[f"out_disp_{scale}_{mode}"], tolerance)
    if mode == "eval" and "out_fused_4" in golden:
        check_features(golden, network, rig)
        pairs = ((one[:6], golden.tensor(f"in_cotangent_{scale}") / 32) for scale, one in enumerate(disparities))
        sum((one * cotangent).sum() for one, cotangent in pairs).backward()
        assert_equal(images.grad[:2], golden["out_grad_image"], GRADIENT)
    if "out_positions_512_12x20" in golden:
        assert_equal(sine_positions(torch.zeros(512, 12, 20)), golden["out_positions_512_12x20"], FLOAT32)


@torch.no_grad()
def check_features(golden: Golden, network: CrossViewDepthNet, rig: RigImages) -> None:
    own, fused = network.depth_encoder(rig.images.flatten(0, 1)), network.fused_features(rig)
    for level in range(LEVELS):
        assert_equal(own[level].mean((-2, -1)), golden[f"out_feature_mean_{level}"])
        assert_equal(fused[level].mean((-2, -1)), golden[f"out_fused_mean_{level}"])
    assert_equal(fused[4][:6], golden["out_fused_4"])


@torch.no_grad()
def test_j_corrected_depth_net_of_tokens_that_stay_where_they_are(path):
    golden, released = Golden(path), Golden(path.with_name(path.name.replace("j_corrected_", "b_")))
    network = depth_network(golden, path.stem, RELEASED.model_copy(update={"released_layout": False}))
    for scale, disparity in enumerate(network.pyramid(rig_of(released.tensor("in_image")[:6] / 255))):
        assert_equal(disparity.flatten(0, 1), golden[f"out_disp_{scale}_eval"])


@torch.no_grad()
def test_c_pose_net_of_all_views_together_and_of_each_alone(path):
    golden = Golden(path)
    network = PoseNet("resnet34" if "resnet34" in path.stem else "resnet18").double().eval()
    seed = int(golden["in_weight_seed"])
    state = {
        key: weight(released_pose_key(key), released_pose_shape(key, like), seed)
        for key, like in network.state_dict().items()
    }
    network.load_state_dict(
        {key: value[: len(network.state_dict()[key])] if value.ndim else value for key, value in state.items()}
    )
    frames = {frame: golden.tensor(f"in_color_{frame}") / 255 for frame in ("m1", "0", "p1")}
    base_T_camera = golden.tensor("in_base_T_camera").unflatten(0, (-1, 6))
    for context, (earlier, later) in zip(CONTEXTS, (("m1", "0"), ("0", "p1")), strict=True):
        for kind, views in (("joint", 6), ("separate", 1)):
            vectors = network(*(frames[frame].unflatten(0, (-1, views)) for frame in (earlier, later)))
            motion = motion_to_context(*vectors, backward=context == "m1")
            for name, ours in zip(("axis_angle", "translation"), vectors, strict=True):
                both_slots = golden[f"out_{kind}_{name}_{context}"]
                assert_equal(ours, both_slots[:, 0, 0])  # the second slot is never used
            if kind == "joint":
                motion = distribute_vehicle_motion(motion[:, None], base_T_camera)[:, 0].flatten(0, 1)
            assert_equal(motion, golden[f"out_{kind}_cam_T_cam_{context}"], SINGULAR_AXIS)


def released_pose_key(key: str) -> str:
    return key.replace("pose_decoder.", "pose.")


def released_pose_shape(key: str, like: Tensor) -> Tensor:
    """The program has twelve rows where six are used."""
    return like.new_zeros(12, *like.shape[1:]) if key.startswith("pose_decoder.net.3.") else like


def test_d_pose_of_the_vehicle_becomes_that_of_each_camera(path):
    golden = Golden(path)
    vectors = [golden.tensor(f"in_{name}").requires_grad_() for name in ("axis_angle", "translation")]
    base_T_camera, total = golden.tensor("in_base_T_camera").unflatten(0, (-1, 6)), torch.zeros(())
    for context, cotangent in zip(CONTEXTS, golden.tensor("in_cotangent"), strict=True):
        vehicle = motion_to_context(*vectors, backward=context == "m1")
        assert_equal(vehicle, golden[f"out_vehicle_motion_{context}"], SINGULAR_AXIS)
        cameras = distribute_vehicle_motion(vehicle[:, None], base_T_camera)[:, 0].flatten(0, 1)
        assert_equal(cameras, golden[f"out_cam_T_cam_{context}"], SINGULAR_AXIS)
        total = total + (cameras * cotangent).sum()
    total.backward()
    for name, vector in zip(("axis_angle", "translation"), vectors, strict=True):
        assert_equal(vector.grad[1:], golden[f"out_grad_{name}"], 10 * SINGULAR_AXIS)


@pytest.mark.parametrize("encoder", ["resnet18", "resnet34"])
def test_networks_have_the_names_and_shapes_of_the_released_checkpoints(request, encoder):
    directory = golden_directory(request.config)
    listed = {
        f"{file}.{line.split(chr(9))[0]}": line.split(chr(9))[1]
        for file in ("depth", f"encoder_{encoder}")
        for line in (directory / f"state_dict_{file}.txt").read_text().splitlines()
        if "\t[" in line
    }
    with torch.device("meta"):
        network = CrossViewDepthNet(encoder, RELEASED)
    ours = {b: f"depth.{a}" for a, b in DECODER_NAMES.items()} | {
        "depth_encoder.encoder.": f"encoder_{encoder}.encoder."
    }
    found = {key: str(list(value.shape)) for key, value in renamed(network.state_dict(), ours).items()}
    unused = {key for key in listed if ".fc." in key}
    assert found == {key: shape for key, shape in listed.items() if key not in unused}


def test_z_no_array_of_what_is_built_was_left_out(request):
    """The last test of the file: between them, the tests above have looked at every output of these families."""
    selected = request.config.getoption("keyword") or any("::" in argument for argument in request.config.args)
    if selected:
        pytest.skip("only meaningful after the whole file")
    files = {path.name for path in golden_directory(request.config).glob("*.npz") if path.name[0] in BUILT}
    assert {name[0] for name in files} == set(BUILT)
    assert files == set(Golden.unseen)
    assert {name: left for name, left in Golden.unseen.items() if left} == {}
