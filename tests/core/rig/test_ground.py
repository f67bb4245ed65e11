# SPDX-License-Identifier: Apache-2.0
"""A rig that cannot be right about the ground is refused by name where a network is told it, and only there."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simple_worlds import two_cameras

from cvcdepth_core.errors import RigError
from cvcdepth_core.estimator import DepthEstimator, SurroundDepthEstimator
from cvcdepth_core.networks import DepthModelSpec
from cvcdepth_core.rig.ground import heights_above_ground, refuse_unlikely_ground
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.rig.rig_file import load_rig_layout, save_rig_layout

RIG = two_cameras().complete()
TOLD = {"encoder": "efficientnet_lite0", "height": 64, "width": 96, "min_depth": 0.4, "max_depth": 250.0}


def turned(camera: Camera, axis: int, degrees: float) -> Camera:
    """The camera turned about an axis of its own: 0 to the right, 2 ahead."""
    angle, pose = np.radians(degrees), camera.base_T_camera.copy()
    turn = np.eye(3)
    first, second = [i for i in range(3) if i != axis]
    turn[[first, second], [first, second]] = np.cos(angle)
    turn[first, second], turn[second, first] = -np.sin(angle), np.sin(angle)
    pose[:3, :3] = pose[:3, :3] @ turn
    return replace(camera, base_T_camera=pose)


def all_turned(axis: int, degrees: float) -> Rig:
    return replace(RIG, cameras=tuple(turned(camera, axis, degrees) for camera in RIG.cameras))


def test_cameras_are_as_high_as_the_ground_lies_below_the_base_frame():
    before, after = heights_above_ground(RIG), heights_above_ground(replace(RIG, ground_height=-0.4))
    assert after == pytest.approx({name: height + 0.4 for name, height in before.items()})
    assert before == {camera.name: camera.base_T_camera[2, 3] for camera in RIG.cameras}


def test_a_rig_file_keeps_the_height_of_the_ground(tmp_path: Path):
    layout = two_cameras().model_copy(update={"ground_height": -0.35})
    save_rig_layout(tmp_path / "rig.yaml", layout)
    assert load_rig_layout(tmp_path / "rig.yaml").complete().ground_height == -0.35
    save_rig_layout(tmp_path / "plain.yaml", two_cameras())
    assert "ground_height" not in (tmp_path / "plain.yaml").read_text()


@pytest.mark.parametrize("text", ["-30", "nan", "low"])
def test_an_impossible_height_is_refused_with_file_field_and_value(tmp_path: Path, text: str):
    save_rig_layout(tmp_path / "rig.yaml", two_cameras())
    with (tmp_path / "rig.yaml").open("a") as file:
        file.write(f"ground_height: {'.nan' if text == 'nan' else text}\n")
    with pytest.raises(RigError, match=r"rig file .*rig.yaml: ground_height: .*"):
        load_rig_layout(tmp_path / "rig.yaml")


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (
            replace(RIG, ground_height=1.5),
            r"camera \w+: -?0\.\d+ m above the ground, .* expected 0.2 to 6; write .*1.5",
        ),
        (replace(RIG, ground_height=-9.0), r"camera \w+: 1\d\.\d+ m above the ground"),
        (all_turned(2, 180.0), r"camera \w+: is mounted upside down by its transform"),
        (all_turned(0, 85.0), r"cameras \w+, \w+: none looks below the horizon"),
    ],
    ids=["in the ground", "far above it", "upside down", "sky only"],
)
def test_a_rig_that_cannot_be_right_is_refused_by_name_and_only_of_a_network_that_is_told_it(rig: Rig, words: str):
    with pytest.raises(RigError, match=words):
        refuse_unlikely_ground(rig)
    with pytest.raises(RigError, match=words):
        SurroundDepthEstimator(rig, estimator("rig_conditioned"))
    SurroundDepthEstimator(rig, estimator("per_camera"))


def estimator(network: str) -> DepthEstimator:
    return DepthEstimator.untrained(DepthModelSpec(network=network, **TOLD), "cpu", backend="torch_eager")


def test_depth_of_a_network_that_is_told_the_rig_follows_the_ground_and_no_other_does():
    def depth(network: str, ground_height: float) -> np.ndarray:
        rig = replace(RIG, ground_height=ground_height)
        surround = SurroundDepthEstimator(rig, estimator(network))
        return surround.estimate(list(pictures(len(rig.cameras)))).depth

    told: Callable[[float], np.ndarray] = lambda height: depth("rig_conditioned", height)  # noqa: E731
    assert np.nanmax(np.abs(told(-0.5) / told(0.0) - 1)) > 0.01
    np.testing.assert_array_equal(depth("per_camera", -0.5), depth("per_camera", 0.0))


def pictures(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, TOLD["height"], TOLD["width"], 3), dtype=np.uint8)
