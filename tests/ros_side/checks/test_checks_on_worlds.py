# SPDX-License-Identifier: Apache-2.0
"""`check` on a rendered drive: it finds swapped cameras, a turned mount and wrong odometry, and nothing where all is
right. Depth for comparing pictures is the true one: what is tested is the judgement, not a network.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from recordings import entries_of, write_rosbag2
from rendered_drive import FAR, TrueDrive, pinhole_rig, turned
from simple_worlds import street_spec

from cvcdepth_core.rig.rig_file import RigLayout, save_rig_layout
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_core.worlds.description import Drive
from cvcdepth_core.worlds.drive import DriveSpec, SimulatedDrive
from cvcdepth_core.worlds.sensors import Odometry, Sensors
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.checks import CheckContext, CheckOptions, CheckResult
from cvcdepth_ros.checks.depth_checks import check_mounts, check_odometry
from cvcdepth_ros.recordings.compared_pictures import Part, compare_pictures
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.simulation.recording import record
from cvcdepth_ros.simulation.set_messages import Form, motion_messages

pytest.importorskip("embreex", reason="worlds need embreex")

SETS = 14
RIG = pinhole_rig((0.0, 55.0, -55.0), (128, 80), 80.0)
SPEC = DriveSpec(
    layout=RIG,
    world=street_spec(drive=Drive(at=(16.0, -1.6), speeds=((0.0, 6.0),))),
    sensors=Sensors(stagger=0.0, lidar=None),
    seconds=SETS / 10,
    samples=1,
)


class _TrueDepth:
    """Gives the true depth of the rendered set whose pictures are most like those that it is shown."""

    model_id, independent = "truth", True

    def __init__(self, spec: DriveSpec) -> None:
        self._drive = TrueDrive(spec)
        self.height, self.width = self._drive.true_set(0).depth.shape[1:]
        self.spec = self

    def estimate(self, surround: SurroundPictures) -> np.ndarray:
        sets = [self._drive.true_set(number) for number in range(SETS)]
        unlike = [np.abs(found.pictures.astype(int) - surround.pictures).mean() for found in sets]
        assert min(unlike) < 3
        return np.minimum(sets[int(np.argmin(unlike))].depth, FAR).astype(np.float32)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "drive"
    record(SPEC, Form(images="png", truth="none"), folder)
    return folder


@pytest.fixture(scope="module")
def truth() -> _TrueDepth:
    return _TrueDepth(SPEC)


def compared(path: Path, layout: RigLayout, truth: _TrueDepth) -> tuple[CheckResult, CheckResult]:
    """What the checks of mounts and odometry say when the recording is read with this rig."""
    with open_recording(path) as recording:
        context = CheckContext(recording, CheckOptions(pictures=True), layout)
        part = Part(recording.start, recording.end + 1)
        rig = RecordedRig.from_recording(recording, layout)
        context.compared = compare_pictures(rig, truth, [part], MatchingSettings())
        return check_mounts(context), check_odometry(context)


def test_a_right_rig_and_right_odometry_pass(drive: Path, truth: _TrueDepth):
    mounts, odometry = compared(drive, RIG, truth)
    assert (mounts.status, odometry.status) == ("passed", "passed"), (mounts.finding, odometry.finding)


def test_a_turned_mount_is_found_by_name_and_size(drive: Path, truth: _TrueDepth):
    mounts, _ = compared(drive, turned(RIG, 1, 0.9), truth)
    assert mounts.status == "warning"
    assert re.search(
        r"neighbours disagree by (0\.[89]|1\.0) degrees \(camera_(0 - camera_1|1 - camera_0)\)", mounts.finding
    )


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (Odometry(scale=1.4), r"another scale: it drives 1\.(3[6-9]|4[0-4]) times as far"),
        (Odometry(scale=0.001), r"odometry stands still while the pictures move at [56]\.\d m/s"),
    ],
)
def test_wrong_odometry_is_told(drive: Path, truth: _TrueDepth, tmp_path: Path, wrong: Odometry, said: str):
    _, odometry = compared(with_odometry(drive, wrong, tmp_path / "wrong"), RIG, truth)
    assert odometry.status == "warning"
    assert re.search(said, odometry.finding)


def with_odometry(drive: Path, odometry: Odometry, folder: Path) -> Path:
    """The recording with what the vehicle believes of its motion replaced."""
    sensors = SPEC.sensors.model_copy(update={"odometry": odometry})
    told = motion_messages(SimulatedDrive(SPEC.model_copy(update={"sensors": sensors})))
    topics = {message.topic for message in told}
    kept = [entry for entry in entries_of(drive) if entry.topic not in topics]
    anew = [type(kept[0])(message.topic, message.type, message.log_time, message.cdr) for message in told]
    return write_rosbag2(folder, sorted([*kept, *anew], key=lambda entry: entry.log_time))


def places(drive: Path, layout: RigLayout, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    save_rig_layout(folder / "rig.yaml", layout)
    main(["check", str(drive), "--rig", str(folder / "rig.yaml")])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if " places " in line]
    return line


def exchanged(first: int, second: int) -> RigLayout:
    """The rig with the mounts of two cameras exchanged."""
    cameras: Sequence = RIG.cameras
    poses = [camera.base_T_camera for camera in cameras]
    poses[first], poses[second] = poses[second], poses[first]
    moved = [c.model_copy(update={"base_T_camera": pose}) for c, pose in zip(cameras, poses, strict=True)]
    return RIG.model_copy(update={"cameras": tuple(moved)})


@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 2), (0, 2)])
def test_swapped_cameras_are_named(
    first: int, second: int, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert f"camera_{first} and camera_{second} seem to be swapped" in places(
        drive, exchanged(first, second), tmp_path, capsys
    )


def test_cameras_in_their_places_pass(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert "no two cameras fit better when exchanged" in places(drive, RIG, tmp_path, capsys)
