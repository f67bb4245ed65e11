# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings: the same bytes for any number of workers, and true in every message, by our own readers."""

from pathlib import Path

import numpy as np
import pytest
from simple_worlds import LENSES, short_drive

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_core.worlds.drive import SimulatedDrive
from cvcdepth_core.worlds.sensors import Odometry
from cvcdepth_core.worlds.world_file import load_world
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.conversion import picture_from_message, stamp_ns
from cvcdepth_ros.recordings.lidar import LidarSweeps
from cvcdepth_ros.recordings.rig import RecordedRig, discover_rig
from cvcdepth_ros.settings import LIDAR_TOLERANCE
from cvcdepth_ros.simulation.recording import record
from cvcdepth_ros.simulation.set_messages import Form, set_messages, stamp_of, truth_topic

pytest.importorskip("embreex", reason="worlds need embreex")

SPEC = short_drive()
EXACT = Form(images="png", truth="all")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("one") / "drive"
    record(SPEC, EXACT, folder)
    return folder


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return SimulatedDrive(SPEC)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def messages(folder: Path, topic: str) -> list:
    with open_recording(folder) as recording:
        return [recording.deserialize(message) for message in recording.messages([topic])]


def test_two_workers_write_the_same_bytes_as_one(recorded: Path, tmp_path: Path):
    record(SPEC, EXACT, tmp_path / "drive", workers=2)
    assert contents(tmp_path / "drive") == contents(recorded)
    assert not (tmp_path / "drive.parts").exists()


def test_an_interrupted_run_goes_on_with_the_same_bytes(recorded: Path, tmp_path: Path):
    def interrupt(done: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(SPEC, EXACT, tmp_path / "drive", progress=interrupt)
    assert not (tmp_path / "drive").exists()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "drive.parts").glob("set_*")}
    assert len(kept) == 2
    seen: list[int] = []

    def progress(done: int) -> None:
        seen.append(done)
        assert all(path.stat().st_mtime_ns == time for path, time in kept.items())

    record(SPEC, EXACT, tmp_path / "drive", progress=progress)
    assert seen == [2, 3]
    assert contents(tmp_path / "drive") == contents(recorded)


def test_parts_of_another_drive_are_refused_and_a_finished_one_is_not_overwritten(recorded: Path, tmp_path: Path):
    def interrupt(done: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(SPEC, EXACT, tmp_path / "drive", progress=interrupt)
    with pytest.raises(ConfigError, match=r"drive\.parts: begun with other options; remove it"):
        record(SPEC, EXACT._replace(truth="none"), tmp_path / "drive")
    with pytest.raises(RecordingError, match="exists already, will not be overwritten"):
        record(SPEC, EXACT, recorded)


def test_another_seed_gives_other_noise_alone(drive: SimulatedDrive):
    noisy = [
        SimulatedDrive(short_drive(seed=seed, looks=(SPEC.sensors.looks[0].model_copy(update={"noise": 0.05}),)))
        for seed in (1, 2)
    ]
    first, second = (each.shoot(0, 0) for each in noisy)
    assert (first.picture != second.picture).any()
    assert (first.truth.depth == second.truth.depth).all()
    assert (first.truth.depth == drive.shoot(0, 0).truth.depth).all()


def test_rig_world_and_choices_lie_beside_the_recording(recorded: Path):
    assert load_rig_layout(recorded / "rig.yaml") == SPEC.layout
    assert load_world(recorded / "world.yaml") == SPEC.world
    assert {"metadata.yaml", "simulation.json", "drive.mcap"} < contents(recorded).keys()


def test_the_rig_that_is_found_in_the_recording_is_the_one_that_was_simulated(recorded: Path):
    with open_recording(recorded) as recording:
        found = {camera.name: camera for camera in discover_rig(recording).cameras}
    for camera in SPEC.layout.cameras:
        assert found[camera.name].image_topic == camera.image_topic
        assert found[camera.name].frame_id == camera.frame_id
        assert found[camera.name].calibration.k == camera.calibration.k
        pose = found[camera.name].base_T_camera.matrix("found")
        assert pose == pytest.approx(camera.base_T_camera.matrix("given"), abs=1e-9)


def test_pictures_and_truth_are_those_of_the_drive_at_their_stamps(recorded: Path, drive: SimulatedDrive):
    for index, camera in enumerate(drive.rig.cameras):
        pictures = messages(recorded, SPEC.layout.cameras[index].image_topic)
        depths, objects, moving = (
            messages(recorded, truth_topic(camera.name, w)) for w in ("depth", "objects", "moving")
        )
        assert len(pictures) == len(depths) == SPEC.sets == 3
        for number in range(3):
            shot = drive.shoot(index, number)
            stamp = stamp_of(SPEC.camera_time(camera, number))
            assert stamp_ns(pictures[number]) == stamp_ns(depths[number]) == stamp
            assert depths[number].encoding == "32FC1"
            assert (picture_from_message(pictures[number], camera.name) == shot.picture).all()
            depth = depths[number].data.view("<f4").reshape(40, 64)
            assert (depth == shot.truth.depth.astype(np.float32)).all()
            assert np.isinf(depth).any()
            assert (objects[number].data.view("<u2").reshape(40, 64) == shot.truth.objects).all()
            assert ((moving[number].data.reshape(40, 64) > 0) == shot.truth.moving).all()


def test_normals_and_flow_are_recorded_as_pixels_of_the_picture(recorded: Path, drive: SimulatedDrive):
    for index, camera in enumerate(drive.rig.cameras):
        normals, flows = (messages(recorded, truth_topic(camera.name, what)) for what in ("normals", "flow"))
        assert (normals[0].encoding, flows[0].encoding) == ("32FC3", "32FC2")
        first, second = (drive.shoot(index, number).truth for number in (0, 1))
        assert (normals[0].data.view("<f4").reshape(40, 64, 3) == first.normals).all()
        moved = flows[0].data.view("<f4").reshape(40, 64, 2)
        assert (np.isnan(moved[..., 0]) >= np.isinf(first.depth)).all()
        # What moves by so many pixels is seen there in the next picture, but for what is hidden by then.
        rows, columns = np.nonzero(np.isfinite(moved[..., 0]))
        x, y = np.rint(moved[rows, columns] + np.stack([columns, rows], axis=1)).astype(int).T
        inside = (x >= 0) & (x < 64) & (y >= 0) & (y < 40)
        assert inside.mean() > 0.7
        again = second.objects[y[inside], x[inside]] == first.objects[rows[inside], columns[inside]]
        assert again.mean() > 0.9


def test_cameras_fire_when_the_lidar_looks_where_they_look():
    front, left = SPEC.layout.complete().cameras
    assert SPEC.camera_time(front, 1) == SPEC.set_time(1)
    # 60 degrees to the left comes first, for the LiDAR turns clockwise; 0.4 of the period of 0.1 s is spread.
    assert SPEC.camera_time(left, 1) - SPEC.set_time(1) == pytest.approx(-60 / 360 * 0.1 * 0.4)


def test_lidar_points_lie_in_the_depth_images_of_the_recording_to_1e_4(recorded: Path):
    with open_recording(recorded) as recording:
        recorded_rig = RecordedRig.from_recording(recording)
        motion = recorded_rig.vehicle_motion()
        assert motion is not None
        assert motion.topic == "/tf"
        sweeps = LidarSweeps(["/lidar/points"], "base_link", recorded_rig.transforms, motion, LIDAR_TOLERANCE)
        for message in recording.messages(["/tf", "/lidar/points"]):
            content = recording.deserialize(message)
            motion.add(content) if message.topic == "/tf" else sweeps.add(message.topic, content)
    K = LENSES["no distortion"].raw_intrinsics
    compared = 0
    for camera in SPEC.layout.complete().cameras:
        for image in messages(recorded, truth_topic(camera.name, "depth")):
            swept = sweeps.points_at(stamp_ns(image))
            assert swept is not None
            points = swept @ inverse(camera.base_T_camera)[:3, :3].T + inverse(camera.base_T_camera)[:3, 3]
            points = points[points[:, 2] > 1.0]
            errors = depth_errors(image.data.view("<f4").reshape(40, 64).astype(float), points, K)
            compared += len(errors)
            # What moves is not where the sweep saw it, and edges hide points: the others agree.
            assert np.quantile(np.abs(errors), 0.8) < 1e-4
    assert compared > 300


def depth_errors(depth: np.ndarray, points: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Relative errors where the inverse depth of the four pixels around a point is that of a plane."""
    x, y = (points[:, i] / points[:, 2] * K[i, i] + K[i, 2] for i in (0, 1))
    inside = (x > 1) & (x < 61) & (y > 1) & (y < 37)
    x, y, z = x[inside], y[inside], points[inside, 2]
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    inverse_depth = 1 / depth
    wide = np.stack([inverse_depth[row + dy, column + dx] for dy in range(-1, 3) for dx in range(-1, 3)], axis=1)
    basis = np.array([(dx, dy, 1.0) for dy in range(-1, 3) for dx in range(-1, 3)])
    plane, residual, _, _ = np.linalg.lstsq(basis, wide.T, rcond=None)
    flat = residual < 1e-13
    value = plane[0] * (x - column) + plane[1] * (y - row) + plane[2]
    return (value * z - 1)[flat]


def test_odometry_with_errors_is_what_tf_tells_and_the_truth_has_a_topic_of_its_own(tmp_path: Path):
    spec = short_drive(odometry=Odometry(scale=1.2), lidar=None)
    result = record(spec, Form(truth="none"), tmp_path / "drive")
    assert "/lidar/points" not in result["messages"]
    told, true = (messages(tmp_path / "drive", topic)[-1].pose.pose.position for topic in ("/odom", "/truth/odom"))
    start = messages(tmp_path / "drive", "/odom")[0].pose.pose.position
    assert told.x - start.x == pytest.approx(1.2 * (true.x - start.x), rel=1e-3)
    (last,) = messages(tmp_path / "drive", "/tf")[-1].transforms
    assert last.transform.translation.x == told.x


def test_raw_pictures_lie_on_raw_topics(drive: SimulatedDrive):
    from cvcdepth_ros.simulation.set_messages import recorded_layout

    layout = recorded_layout(SPEC.layout, "raw")
    assert [camera.image_topic for camera in layout.cameras] == ["/camera/front/image_raw", "/camera/left/image_raw"]
    raw = SimulatedDrive(SPEC.model_copy(update={"layout": layout}))
    types = {message.topic: message.type for message in set_messages(raw, 0, Form(images="raw"))}
    assert types["/camera/front/image_raw"] == "sensor_msgs/msg/Image"
