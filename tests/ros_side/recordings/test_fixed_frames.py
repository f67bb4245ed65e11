# SPDX-License-Identifier: Apache-2.0
"""Recordings whose sensors are on /tf, as those made of nuScenes are: taken where they are fixed, refused where not."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
from recordings import JAZZY, SAMPLE, Entry

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.rig import RecordedRig, discover_rig

Change = Callable[[int, Any], None]


def on_tf(path: Path, change: Change = lambda number, link: None, sets: int = 3, *, fixed_first: bool = False) -> Path:
    """The sample with all its fixed links in every message of /tf, after or before the moving one, none on /tf_static.

    `change` is given each of these links and the number of its message.
    """
    entries = recordings.sample_entries(sets)
    (static,) = (entry for entry in entries if entry.topic == "/tf_static")
    others = recordings.without(entries, "/tf_static")
    return recordings.write_rosbag2(path, list(_repeated(others, static, change, fixed_first)))


def _repeated(entries: list[Entry], static: Entry, change: Change, fixed_first: bool) -> Iterator[Entry]:
    number = 0

    def add_fixed(message: Any) -> None:
        nonlocal number
        links = JAZZY.deserialize_cdr(static.cdr, static.type).transforms
        for link in links:
            change(number, link)
        message.transforms = [*links, *message.transforms] if fixed_first else [*message.transforms, *links]
        number += 1

    yield from recordings.changed(entries, "/tf", add_fixed)


def shaking(child: str, metres: float) -> Change:
    def shake(number: int, link: Any) -> None:
        if link.child_frame_id == child:
            link.transform.translation.x += metres * (number % 2)

    return shake


def rig_of(path: Path) -> RigLayout:
    with open_recording(path) as recording:
        return discover_rig(recording)


def test_cameras_and_lidar_on_tf_are_found_where_they_do_not_move(tmp_path: Path):
    path = on_tf(tmp_path / "bag")
    assert rig_of(path) == rig_of(SAMPLE)
    with open_recording(path) as moved, open_recording(SAMPLE) as sample:
        trees = [RecordedRig.from_recording(recording, rig_of(SAMPLE)).transforms for recording in (moved, sample)]
    lidar = [tree.lookup("base_link", "pandar64") for tree in trees]
    np.testing.assert_array_equal(*lidar)


def test_the_vehicles_own_motion_is_no_fixed_frame(tmp_path: Path):
    with open_recording(on_tf(tmp_path / "bag")) as recording:
        tree = RecordedRig.from_recording(recording).transforms
    assert "odom" not in tree.frames


def test_rounding_is_no_motion_and_a_centimetre_is(tmp_path: Path):
    frame = "left_camera_optical_frame"
    assert rig_of(on_tf(tmp_path / "still", shaking(frame, 1e-5))).names == rig_of(SAMPLE).names
    with pytest.raises(
        TransformError, match=rf"moving: /tf: base_link <- {frame} moves .* by up to 0\.010 m and 0\.00 d"
    ):
        rig_of(on_tf(tmp_path / "moving", shaking(frame, 0.01)))


def test_a_camera_that_turns_is_refused(tmp_path: Path):
    def turn(number: int, link: Any) -> None:
        if link.child_frame_id == "left_camera_optical_frame" and number:
            rotation = link.transform.rotation
            rotation.x, rotation.y, rotation.z, rotation.w = 0.0, 0.0, 0.0, 1.0

    with pytest.raises(TransformError, match=r"moves during the recording, by up to 0\.000 m and \d+\.\d\d degrees"):
        rig_of(on_tf(tmp_path / "bag", turn))


def test_a_lidar_that_moves_is_no_truth_and_the_cameras_remain(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = on_tf(tmp_path / "bag", shaking("pandar64", 0.05))
    options = ["--predictor", "constant", "--height", "64", "--width", "96", "--no-report", "--quiet"]
    assert main(["evaluate", str(path), *options, "-o", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr()
    assert "0 truth points" in captured.out
    assert "no transform base_link <- pandar64: /tf: base_link <- pandar64 moves during the recording" in captured.err


@pytest.mark.parametrize("fixed_first", [False, True])
def test_a_recording_with_all_sensors_on_tf_is_scored_as_with_tf_static(
    fixed_first: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    static = recordings.write_rosbag2(tmp_path / "static", recordings.sample_entries(3))
    options = ["--predictor", "constant", "--height", "64", "--width", "96", "--no-report", "--quiet"]
    scores = []
    for path in (static, on_tf(tmp_path / "tf", fixed_first=fixed_first)):
        assert main(["evaluate", str(path), *options, "-o", str(tmp_path / f"{path.name}_out")]) == 0
        scores.append(capsys.readouterr().out.splitlines()[:-1])
    assert scores[0] == scores[1]


def test_check_says_that_the_cameras_are_connected_by_tf(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["check", str(on_tf(tmp_path / "bag")), "--quiet"])
    said = " ".join(capsys.readouterr().out.split())
    assert "every camera is connected to base_link (on /tf, where they do not move: back_camera" in said
