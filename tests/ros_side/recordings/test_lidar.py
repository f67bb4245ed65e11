# SPDX-License-Identifier: Apache-2.0
"""LiDAR sweeps at any moment, and the vehicle's motion that takes them there."""

import math
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from clouds import SECOND, cloud, header
from recordings import SAMPLE

from cvcdepth_core.errors import ConfigError, TransformError
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.ground_truth import sample_prediction, sparse_depth
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import ALL, ScoreSettings
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.recordings.lidar import LidarSweeps
from cvcdepth_ros.recordings.motion import MotionLink, VehicleMotion
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.truth import RecordedTruth
from cvcdepth_ros.settings import LIDAR_TOLERANCE


def moved(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:2, 3] = x, y
    return pose


@pytest.fixture
def static() -> TransformTree:
    tree = TransformTree()
    tree.add("base_link", "lidar", moved(x=1.0))
    tree.add("base_footprint", "base_link", moved(y=0.5))
    return tree


def odometry(stamp: int, x: float, yaw: float = 0.0) -> SimpleNamespace:
    position = SimpleNamespace(x=x, y=0.0, z=0.0)
    orientation = SimpleNamespace(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    pose = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=orientation))
    return SimpleNamespace(header=header(stamp, "odom"), child_frame_id="base_footprint", pose=pose)


def driving(speed: float, yaw_rate: float = 0.0, child_T_base: np.ndarray | None = None) -> VehicleMotion:
    child_T_base = np.eye(4) if child_T_base is None else child_T_base
    motion = VehicleMotion(MotionLink("/odom", "odom", "base_link", child_T_base))
    for tenths in range(11):
        motion.add(odometry(tenths * SECOND // 10, speed * tenths / 10, yaw_rate * tenths / 10))
    return motion


def test_a_sweep_is_moved_to_where_the_vehicle_was_when_the_camera_fired(static):
    sweeps = LidarSweeps(["/lidar"], "base_link", static, driving(speed=10.0), LIDAR_TOLERANCE)
    sweeps.add("/lidar", cloud([(5.0, 2.0, 1.0)], stamp=SECOND // 2))
    # 0.05 s later the car has come 0.5 m nearer; the LiDAR sits 1 m ahead of the base.
    assert sweeps.points_at(SECOND * 55 // 100) == pytest.approx(np.array([[5.5, 2.0, 1.0]]))


def test_turning_and_a_frame_fixed_to_the_base_are_taken_into_account(static):
    # The track is that of a frame 2 m behind the base frame.
    motion = driving(speed=0.0, yaw_rate=math.pi, child_T_base=moved(x=2.0))
    sweeps = LidarSweeps(["/lidar"], "base_link", static, motion, tolerance=0.5)
    sweeps.add("/lidar", cloud([(2.0, 0.0, 0.0)], stamp=0))
    # A quarter turn to the left about that frame: what was 5 m ahead of it is now 5 m to its right.
    assert sweeps.points_at(SECOND // 2) == pytest.approx(np.array([[-2.0, -5.0, 0.0]]))


def test_without_recorded_motion_the_vehicle_stands_still(static):
    sweeps = LidarSweeps(["/lidar"], "base_link", static, None, LIDAR_TOLERANCE)
    sweeps.add("/lidar", cloud([(5.0, 2.0, 1.0)], stamp=0))
    assert sweeps.points_at(SECOND // 20) == pytest.approx(np.array([[6.0, 2.0, 1.0]]))


def test_motion_that_is_not_known_at_the_moment_is_an_error_and_not_a_standstill(static):
    sweeps = LidarSweeps(["/lidar"], "base_link", static, driving(1.0), LIDAR_TOLERANCE)
    sweeps.add("/lidar", cloud(stamp=SECOND))
    with pytest.raises(TransformError, match="no transform odom <- base_link at 1050000000 ns"):
        sweeps.points_at(SECOND * 105 // 100)


def test_each_lidar_gives_its_nearest_sweep_and_late_ones_give_none(static):
    sweeps = LidarSweeps(["/a", "/b"], "base_link", static, None, tolerance=0.1)
    assert sweeps.points_at(0) is None
    for stamp in (0, SECOND // 10, SECOND // 5):
        sweeps.add("/a", cloud([(stamp / SECOND, 0, 1)], stamp=stamp))
    sweeps.add("/b", cloud([(9, 9, 9)], stamp=SECOND * 3 // 10))
    near_a = sweeps.points_at(SECOND * 12 // 100)
    assert near_a[:, 0] == pytest.approx([1.1])
    both = sweeps.points_at(SECOND * 21 // 100)
    assert both[:, 0] == pytest.approx([1.2, 10.0])
    assert sweeps.points_at(SECOND) is None


def test_forgotten_sweeps_and_poses_are_those_no_later_stamp_needs(static):
    motion = driving(1.0)
    sweeps = LidarSweeps(["/lidar"], "base_link", static, motion, LIDAR_TOLERANCE)
    for tenths in range(10):
        sweeps.add("/lidar", cloud(stamp=tenths * SECOND // 10))
    stamp = SECOND * 55 // 100
    before, pose = sweeps.points_at(stamp), motion.base_pose(stamp)
    sweeps.forget_before(stamp)
    motion.forget_before(SECOND // 2)
    assert np.array_equal(sweeps.points_at(stamp), before)
    assert np.array_equal(motion.base_pose(stamp), pose)
    assert sweeps.points_at(SECOND // 5) is None
    with pytest.raises(TransformError, match="known from 500000000"):
        motion.base_pose(SECOND * 4 // 10)


def test_a_lidar_without_a_transform_is_named():
    sweeps = LidarSweeps(["/lidar"], "base_link", TransformTree(), None, LIDAR_TOLERANCE)
    with pytest.raises(TransformError, match=r"/lidar: no transform base_link <- lidar: frame '\w+' is unknown"):
        sweeps.add("/lidar", cloud())


def test_a_negative_tolerance_is_refused(static):
    with pytest.raises(ConfigError, match=r"-0\.1 s"):
        LidarSweeps([], "base_link", static, None, tolerance=-0.1)


def test_odometry_tells_the_motion_too(static):
    motion = VehicleMotion(MotionLink("/odom", "odom", "base_footprint", static.lookup("base_footprint", "base_link")))
    motion.add(odometry(0, 1.0))
    motion.add(odometry(SECOND // 2, 3.0))
    assert motion.base_pose(SECOND // 4)[:3, 3] == pytest.approx([2.0, 0.5, 0.0])


class Sample(NamedTuple):
    """The shipped recording's rig, its LiDAR and motion read to the end, and the stamps of its left camera."""

    rig: Rig
    truth: RecordedTruth
    stamps: list[int]


@pytest.fixture(scope="module")
def sample() -> Sample:
    with open_recording(SAMPLE) as recording:
        recorded = RecordedRig.from_recording(recording)
        truth = RecordedTruth(recorded)
        truth.read(recording.start, recording.end + 1)
        topic = next(camera.image_topic for camera in recorded.layout.cameras if camera.name == "left")
        stamps = [stamp_ns(recording.deserialize(message)) for message in recording.messages([topic])]
        return Sample(recorded.layout.complete(), truth, stamps)


def test_the_motion_of_the_sample_is_found_in_tf_and_is_that_of_a_driving_car(sample):
    motion = sample.truth.motion
    assert motion.topic == "/tf"
    travelled = np.linalg.norm((motion.base_pose(sample.stamps[-1]) - motion.base_pose(sample.stamps[0]))[:3, 3])
    assert 1.0 < travelled < 6.0  # in 0.9 s


def test_the_samples_lidar_as_prediction_has_no_error_in_any_camera(sample):
    scorer = SurroundScorer("sample", sample.rig.names, ScoreSettings())
    for stamp in sample.stamps[2:4]:
        images = []
        for camera in sample.rig.cameras:
            truth = sparse_depth(sample.truth.points(stamp), camera.rectified_view, OcclusionFilter())
            prediction = sample_prediction(truth.image(), truth)
            images.append(DepthSamples(prediction, truth.depth, np.zeros(len(truth), dtype=bool)))
        scorer.add(stamp, images)
    summary = scorer.scores().summary()
    for scores in summary.cameras.values():
        assert scores[ALL].truth > 500
        assert scores[ALL].coverage == 1.0
        assert scores[ALL].metrics["abs_rel"] < 1e-7  # the picture is float32
