# SPDX-License-Identifier: Apache-2.0
"""CameraInfo as real drivers fill it in, and calibrations that come late or change on the way."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_rig
from recordings import Entry
from small_rig import BEGIN, INFO, TRANSFORMS

from cvcdepth_core.errors import RigError
from cvcdepth_ros.bags import Recording, open_recording
from cvcdepth_ros.messages.camera_info import read_camera_info
from cvcdepth_ros.messages.recorded_changes import find_calibration_changes
from cvcdepth_ros.recordings.replay import SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig, discover_layout, discover_rig
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import build_index

FIVE = (-0.03, 0.035, -0.0001, 0.0002, -0.012)
EIGHT = (*FIVE, 0.2, 0.01, 0.001)


def d(*numbers: float) -> np.ndarray:
    return np.array(numbers, dtype=np.float64)


READ: dict[str, tuple[dict[str, Any], str, tuple[float, ...], int]] = {
    # what is changed, model and coefficients as understood, notes
    "R not set": ({"r": np.zeros(9)}, "plumb_bob", (0.0,) * 5, 1),
    "R and P not set": ({"r": np.zeros(9), "p": np.zeros(12)}, "plumb_bob", (0.0,) * 5, 1),
    "plumb_bob and three zeros": ({"d": d(*FIVE, 0, 0, 0)}, "plumb_bob", FIVE, 1),
    "plumb_bob, 14 zeros": ({"d": np.zeros(14)}, "plumb_bob", (0.0,) * 5, 1),
    "plumb_bob, 3 zeros": ({"d": np.zeros(3)}, "plumb_bob", (0.0,) * 4, 1),
    "plumb_bob, in truth rational": ({"d": d(*EIGHT)}, "rational_polynomial", EIGHT, 1),
    "plumb_bob, in truth rational of 14": (
        {"d": d(*EIGHT, *[0.0] * 6)},
        "rational_polynomial",
        (*EIGHT, *[0.0] * 6),
        1,
    ),
    "rational of 5": (
        {"distortion_model": "rational_polynomial", "d": d(*FIVE)},
        "rational_polynomial",
        (*FIVE, 0, 0, 0),
        1,
    ),
    "rational of zeros": (
        {"distortion_model": "rational_polynomial", "d": np.zeros(8)},
        "rational_polynomial",
        (0.0,) * 8,
        0,
    ),
    "equidistant of 5": (
        {"distortion_model": "equidistant", "d": d(0.1, 0.2, 0.3, 0.4, 0)},
        "equidistant",
        (0.1, 0.2, 0.3, 0.4),
        1,
    ),
    "capitals": ({"distortion_model": "Plumb_Bob", "d": d(*FIVE)}, "plumb_bob", FIVE, 0),
    "no name": ({"distortion_model": "", "d": d()}, "plumb_bob", (), 0),
    "no name, zeros": ({"distortion_model": "", "d": np.zeros(5)}, "plumb_bob", (), 0),
    "none": ({"distortion_model": "none", "d": d()}, "plumb_bob", (), 1),
    "None, zeros": ({"distortion_model": "None", "d": np.zeros(5)}, "plumb_bob", (), 1),
    "pinhole": ({"distortion_model": "pinhole", "d": np.zeros(4)}, "plumb_bob", (), 1),
    "perspective": ({"distortion_model": "perspective", "d": d()}, "plumb_bob", (), 1),
}


@pytest.mark.parametrize("case", READ)
def test_what_says_the_same_in_another_way_is_understood_and_told(case: str):
    changes, model, coefficients, notes = READ[case]
    found = read_camera_info(small_rig.info(BEGIN, "f", **changes), "front")
    assert (found.calibration.distortion_model, found.calibration.d) == (model, coefficients)
    assert np.array_equal(found.calibration.rotation, np.eye(3))
    assert len(found.notes) == notes


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"distortion_model": "pinhole", "d": d(*FIVE)}, "distortion_model.*'pinhole'"),
        ({"distortion_model": "", "d": d(*FIVE)}, "distortion_model"),
        ({"distortion_model": "fisheye", "d": np.zeros(4)}, "distortion_model.*'fisheye'"),
        ({"d": d(*FIVE, 0.1)}, "plumb_bob takes 0 or 4 or 5 numbers in d, found 6"),
        ({"d": d(0.1, 0.2)}, "plumb_bob takes 0 or 4 or 5 numbers in d, found 2"),
        ({"distortion_model": "equidistant", "d": d(*FIVE)}, "equidistant takes 0 or 4 numbers in d, found 5"),
        ({"r": d(0, 0, 0, 0, 0, 0, 0, 0, 1)}, "is not a rotation"),
        ({"k": np.zeros(9), "height": 0, "width": 0}, "the camera is not calibrated"),
    ],
)
def test_what_says_something_else_is_refused_by_name(changes: dict[str, Any], reason: str):
    with pytest.raises(RigError, match=f"camera front: camera_info: .*{reason}"):
        read_camera_info(small_rig.info(BEGIN, "f", **changes), "front")


def uncalibrated(time: int, camera: str) -> Entry:
    zeros = small_rig.info(time, f"{camera}_optical", k=np.zeros(9), p=np.zeros(12), d=np.zeros(0), distortion_model="")
    return small_rig.entry(f"/{camera}/camera_info", INFO, time, zeros)


@pytest.mark.parametrize("camera", small_rig.YAWS)
@pytest.mark.parametrize("count", [1, 20])
def test_a_calibration_that_comes_late_is_used_for_all_and_told(camera: str, count: int, tmp_path: Path):
    early = [uncalibrated(BEGIN - (count - number) * 10**6, camera) for number in range(count)]
    path = small_rig.write_drive(tmp_path, small_rig.in_time(early, small_rig.entries()))
    with open_recording(path) as recording:
        layout = discover_rig(recording)
        replay = SurroundReplay(RecordedRig.from_recording(recording), MatchingSettings())
        sets = list(replay.sets())
        assert len(sets) == 3
        assert replay.rig.names
        assert [note for note in replay.notes if f"camera {camera}: camera_info: the first ones cannot be used" in note]
        assert all(entry.calibration for entry in layout.cameras)


def test_a_camera_that_is_never_calibrated_is_named(tmp_path: Path):
    def forget(message: Any) -> None:
        message.k = np.zeros(9)

    path = small_rig.write_drive(tmp_path, small_rig.entries(change=forget))
    with open_recording(path) as recording, pytest.raises(RigError, match=r"camera ahead: camera_info: K\[0\] = 0"):
        discover_rig(recording)


# Changes on the way

FRAMES = 12
CHANGED_AT = 7


def zoomed(message: Any) -> None:
    message.k = message.k * np.array([1.2, 1, 1, 1, 1.2, 1, 1, 1, 1])


def bent(message: Any) -> None:
    message.d = np.array([-0.2, 0.05, 0, 0, 0])


def shifted(message: Any) -> None:
    message.p = message.p + np.array([0, 0, 3.0, 0, 0, 0, 0, 0, 0, 0, 0, 0])


def changing(change: Callable[[Any], None], at: int = CHANGED_AT, until: int = FRAMES) -> list[Entry]:
    """The drive, in which the port camera's CameraInfo is another one from one frame to another."""
    drive = small_rig.entries(frames=FRAMES)
    other = iter(small_rig.entries(frames=FRAMES, change=change))
    first, last = BEGIN + at * 10**8, BEGIN + until * 10**8
    return [
        changed if entry.topic == "/port/camera_info" and first <= entry.log_time < last else entry
        for entry, changed in zip(drive, other, strict=True)
    ]


def changes_of(recording: Recording) -> list[str]:
    layout = discover_layout(recording, "base_link")
    firsts = recording.first_messages([camera.camera_info_topic for camera in layout.cameras])
    return find_calibration_changes(recording, layout, firsts)


@pytest.mark.parametrize(
    ("change", "what"), [(zoomed, "fx 50.0, .*then fx 60.0"), (bent, "then d = "), (shifted, "in P")]
)
def test_a_calibration_that_changes_is_told_with_the_moment(change, what: str, tmp_path: Path):
    with open_recording(small_rig.write_drive(tmp_path, changing(change))) as recording:
        (found,) = changes_of(recording)
        notes = RecordedRig.from_recording(recording).notes()
    assert found.startswith("camera port: its calibration changes")
    assert found.endswith("0.700 s after the beginning")
    assert re.search(what, found)
    assert [note for note in notes if note.startswith(found)]


def test_a_calibration_that_changes_and_returns_is_told_twice(tmp_path: Path):
    with open_recording(small_rig.write_drive(tmp_path, changing(zoomed, 4, 9))) as recording:
        found = changes_of(recording)
    assert [line.rpartition(", ")[2] for line in found] == [
        "0.400 s after the beginning",
        "0.900 s after the beginning",
    ]


def test_a_calibration_that_is_another_one_for_a_moment_only_is_told(tmp_path: Path):
    with open_recording(small_rig.write_drive(tmp_path, changing(zoomed, 5, 6))) as recording:
        found = changes_of(recording)
    assert [line.rpartition(", ")[2] for line in found] == [
        "0.500 s after the beginning",
        "0.600 s after the beginning",
    ]


def test_of_a_long_recording_a_few_moments_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("cvcdepth_ros.messages.recorded_changes._QUICKLY_READ_BYTES", 0)
    with open_recording(small_rig.write_drive(tmp_path, changing(zoomed))) as recording:
        (found,) = changes_of(recording)
    assert found.endswith("0.700 s after the beginning")


def test_a_calibration_that_changes_all_the_time_is_told_in_a_few_lines(tmp_path: Path):
    drive, other = small_rig.entries(frames=40), small_rig.entries(frames=40, change=zoomed)
    mixed = [odd if number % 2 else even for number, (even, odd) in enumerate(zip(drive, other, strict=True))]
    with open_recording(small_rig.write_drive(tmp_path, mixed)) as recording:
        found = [line for line in changes_of(recording) if line.startswith("camera port")]
    assert len(found) == 10
    assert re.fullmatch(r"camera port: its calibration changes \d+ times more", found[-1])


def test_rounding_is_no_change(tmp_path: Path):
    def jitter(message: Any) -> None:
        message.k = message.k + np.array([0.01, 0, 0.01, 0, 0.01, 0, 0, 0, 0])

    with open_recording(small_rig.write_drive(tmp_path, changing(jitter))) as recording:
        assert changes_of(recording) == []


def test_the_replay_takes_each_part_with_its_own_calibration_and_tells(tmp_path: Path):
    with open_recording(small_rig.write_drive(tmp_path, changing(zoomed))) as recording:
        replay = SurroundReplay(RecordedRig.from_recording(recording), MatchingSettings())
        focal = [
            next(camera for camera in replay.rig.cameras if camera.name == "port").calibration.k[0]
            for _ in replay.sets()
        ]
        assert sorted(set(focal)) == [50.0, 60.0]
        assert abs(focal.count(50.0) - CHANGED_AT) <= 1
        (change,) = replay.calibration_changes
    assert "0.700 s after the beginning" in change


def test_nothing_is_learnt_from_a_drive_whose_calibration_changes(tmp_path: Path):
    path = small_rig.write_drive(tmp_path, changing(zoomed))
    with pytest.raises(RigError, match=r"camera port: its calibration changes: .*0.700 s after the beginning; take"):
        build_index(path, MatchingSettings())


def moved(camera: str, height: float, at: int = CHANGED_AT) -> list[Entry]:
    time = BEGIN + at * 10**8
    message = small_rig.make(TRANSFORMS, transforms=[small_rig.mount(time, camera, height)])
    extra = small_rig.entry("/tf_static", TRANSFORMS, time, message)
    return small_rig.in_time(small_rig.entries(frames=FRAMES), [extra])


def test_a_mount_that_changes_is_refused_with_the_moment(tmp_path: Path):
    with (
        open_recording(small_rig.write_drive(tmp_path, moved("port", 1.65))) as recording,
        pytest.raises(
            RigError, match=r"camera port: .*base_link <- port_optical moves 0.700 s after the beginning by 0.050 m"
        ),
    ):
        discover_rig(recording)


def test_a_mount_that_is_told_again_has_not_moved(tmp_path: Path):
    with open_recording(small_rig.write_drive(tmp_path, moved("port", 1.6))) as recording:
        assert len(discover_rig(recording).cameras) == 3


def test_a_fixed_transform_that_carries_no_camera_may_change(tmp_path: Path):
    times = (BEGIN, BEGIN + 5 * 10**8)
    maps = [
        small_rig.entry(
            "/tf_static",
            TRANSFORMS,
            time,
            small_rig.make(TRANSFORMS, transforms=[small_rig.transform(time, "map", "odom", (number, 0, 0))]),
        )
        for number, time in enumerate(times)
    ]
    with open_recording(small_rig.write_drive(tmp_path, small_rig.in_time(small_rig.entries(), maps))) as recording:
        assert len(discover_rig(recording).cameras) == 3


# Where transforms are


def renamed(names: dict[str, str]) -> list[Entry]:
    return [entry._replace(topic=names.get(entry.topic, entry.topic)) for entry in small_rig.entries()]


@pytest.mark.parametrize(
    "names",
    [
        {"/tf_static": "/robot1/tf_static", "/tf": "/robot1/tf"},
        {"/tf_static": "tf_static", "/tf": "tf"},
        {"/tf_static": "/a/b/tf_static"},
    ],
)
def test_transforms_in_a_namespace_or_without_slash_are_used(names: dict[str, str], tmp_path: Path):
    with open_recording(small_rig.write_drive(tmp_path, renamed(names))) as recording:
        recorded = RecordedRig.from_recording(recording)
        told = recorded.notes()
    assert len(recorded.layout.cameras) == 3
    assert any(names["/tf_static"] in note for note in told) == names["/tf_static"].startswith("/")


def test_of_several_robots_the_cameras_own_is_used_or_all_are_named(tmp_path: Path):
    other = [entry._replace(topic="/robot2/tf_static") for entry in small_rig.entries() if entry.topic == "/tf_static"]
    (tmp_path / "one").mkdir()
    near = small_rig.entries("/robot1/{}/image_raw/compressed", info_topic="/robot1/{}/camera_info")
    near = [entry._replace(topic=f"/robot1{entry.topic}") if entry.topic.startswith("/tf") else entry for entry in near]
    with open_recording(small_rig.write_drive(tmp_path / "one", small_rig.in_time(near, other))) as recording:
        assert len(discover_rig(recording).cameras) == 3
    far = small_rig.in_time(renamed({"/tf_static": "/robot1/tf_static"}), other)
    named = "/robot1/tf_static, /robot2/tf_static, of several robots"
    with open_recording(small_rig.write_drive(tmp_path, far)) as recording, pytest.raises(RigError, match=named):
        discover_rig(recording)
