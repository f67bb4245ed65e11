# SPDX-License-Identifier: Apache-2.0
import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.errors import ConfigError, RecordingError, TransformError
from cvcdepth_core.scoring.ground_truth import sample_prediction, sparse_depth
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import ALL, ScoreSettings
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.transforms import PoseTrack, TransformTree
from cvcdepth_ros.recordings.lidar import LidarSweeps, VehicleMotion, cloud_topics, points_from_message
from cvcdepth_ros.recordings.rig import assemble_rig, discover_rig

POINTS = [(1.5, -2.25, 3.0), (10.0, 20.0, -30.0), (0.125, 0.0, 0.0), (7.0, 8.0, 9.0)]
SECOND = 1_000_000_000


def header(stamp: int = 0, frame_id: str = "lidar") -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=stamp // SECOND, nanosec=stamp % SECOND), frame_id=frame_id)


def cloud(
    points=POINTS,
    *,
    kind: str = "f",
    big_endian: bool = False,
    before: int = 0,
    after: int = 0,
    height: int = 1,
    row_padding: int = 0,
    stamp: int = 0,
) -> SimpleNamespace:
    """A PointCloud2 packed by struct: `before` and `after` strange bytes around z, y, x, rows padded."""
    size, order = struct.calcsize(f"<{kind}"), ">" if big_endian else "<"
    packed = [b"\xff" * before + struct.pack(f"{order}3{kind}", z, y, x) + b"\xfe" * after for x, y, z in points]
    width = len(points) // height
    rows = [b"".join(packed[i * width : (i + 1) * width]) + b"\xfd" * row_padding for i in range(height)]
    datatype = {"f": 7, "d": 8}[kind]
    step = before + 3 * size + after
    return SimpleNamespace(
        header=header(stamp),
        height=height,
        width=width,
        fields=[
            SimpleNamespace(name="ring", offset=0, datatype=99, count=1),
            *(
                SimpleNamespace(name=name, offset=before + i * size, datatype=datatype, count=1)
                for i, name in enumerate("zyx")
            ),
        ],
        is_bigendian=big_endian,
        point_step=step,
        row_step=width * step + row_padding,
        data=np.frombuffer(b"".join(rows), dtype=np.uint8),
    )


@pytest.mark.parametrize("kind", ["f", "d"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(
    "layout", [{}, {"before": 3, "after": 5}, {"height": 2}, {"height": 4, "row_padding": 7, "after": 1}]
)
def test_any_layout_of_points_is_read(kind, big_endian, layout):
    message = cloud(kind=kind, big_endian=big_endian, **layout)
    assert points_from_message(message, "/lidar").tolist() == [list(point) for point in POINTS]


def test_points_without_a_return_are_dropped():
    nothing = [(math.nan, 1, 1), (1, math.inf, 1), (0, 0, 0)]
    assert points_from_message(cloud([*nothing, (0, 0, 1)]), "/lidar").tolist() == [[0, 0, 1]]
    assert points_from_message(cloud([]), "/lidar").shape == (0, 3)


def test_a_single_row_needs_no_row_step_and_the_last_row_no_padding():
    message = cloud()
    message.row_step = 0
    assert len(points_from_message(message, "/lidar")) == 4
    padded = cloud(height=2, row_padding=8)
    padded.data = padded.data[:-8]
    assert len(points_from_message(padded, "/lidar")) == 4


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("data", np.zeros(47, np.uint8), "/lidar: data has 47 bytes, but 1 x 4 points of 12 bytes .* need 48"),
        ("height", 2, "/lidar: data has 48 bytes, .* need 96"),
        ("width", 5, "/lidar: data has 48 bytes, .* need 60"),
        ("point_step", 10, "/lidar: field x at offset 8 of 4 bytes is outside of the point_step of 10"),
        ("fields", [], "/lidar: no field x; there are none"),
    ],
)
def test_a_lying_cloud_is_refused_by_topic_and_field(field, value, message):
    broken = cloud()
    setattr(broken, field, value)
    with pytest.raises(RecordingError, match=message):
        points_from_message(broken, "/lidar")


def test_a_field_that_is_no_float_is_refused():
    broken = cloud()
    broken.fields[1].datatype = 5
    with pytest.raises(RecordingError, match="field z has datatype 5, want 7"):
        points_from_message(broken, "/lidar")


def test_rows_that_overlap_are_refused():
    broken = cloud(height=2)
    broken.row_step = 3
    with pytest.raises(RecordingError, match="row_step is 3 bytes, but 2 points of 12 need 24"):
        points_from_message(broken, "/lidar")


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


def driving(speed: float, yaw_rate: float = 0.0, child_T_base: np.ndarray | None = None) -> VehicleMotion:
    track = PoseTrack("odom", "base_link")
    for tenths in range(11):
        t = tenths / 10
        track.add(tenths * SECOND // 10, moved(speed * t, 0.0, yaw_rate * t))
    return VehicleMotion("/tf", track, np.eye(4) if child_T_base is None else child_T_base)


def test_a_sweep_is_moved_to_where_the_vehicle_was_when_the_camera_fired(static):
    sweeps = LidarSweeps(["/lidar"], "base_link", static, driving(speed=10.0))
    sweeps.add("/lidar", cloud([(5.0, 2.0, 1.0)], stamp=SECOND // 2))
    found = sweeps.at(SECOND * 55 // 100)
    # 0.05 s later the car has come 0.5 m nearer; the LiDAR sits 1 m ahead of the base.
    assert found.points == pytest.approx(np.array([[5.5, 2.0, 1.0]]))
    assert found.seconds_later == {"/lidar": pytest.approx(-0.05)}


def test_turning_and_a_frame_fixed_to_the_base_are_taken_into_account(static):
    # The track is that of a frame 2 m behind the base frame.
    motion = driving(speed=0.0, yaw_rate=math.pi, child_T_base=moved(x=2.0))
    sweeps = LidarSweeps(["/lidar"], "base_link", static, motion, tolerance=0.5)
    sweeps.add("/lidar", cloud([(2.0, 0.0, 0.0)], stamp=0))
    # A quarter turn to the left about that frame: what was 5 m ahead of it is now 5 m to its right.
    assert sweeps.at(SECOND // 2).points == pytest.approx(np.array([[-2.0, -5.0, 0.0]]))


def test_without_recorded_motion_the_vehicle_stands_still(static):
    sweeps = LidarSweeps(["/lidar"], "base_link", static, None)
    sweeps.add("/lidar", cloud([(5.0, 2.0, 1.0)], stamp=0))
    assert sweeps.at(SECOND // 20).points == pytest.approx(np.array([[6.0, 2.0, 1.0]]))


def test_motion_that_is_not_known_at_the_moment_is_an_error_and_not_a_standstill(static):
    sweeps = LidarSweeps(["/lidar"], "base_link", static, driving(1.0))
    sweeps.add("/lidar", cloud(stamp=SECOND))
    with pytest.raises(TransformError, match="no transform odom <- base_link at 1050000000 ns"):
        sweeps.at(SECOND * 105 // 100)


def test_each_lidar_gives_its_nearest_sweep_and_late_ones_give_none(static):
    sweeps = LidarSweeps(["/a", "/b"], "base_link", static, None, tolerance=0.1)
    assert sweeps.at(0) is None
    for stamp in (0, SECOND // 10, SECOND // 5):
        sweeps.add("/a", cloud([(stamp / SECOND, 0, 1)], stamp=stamp))
    sweeps.add("/b", cloud([(9, 9, 9)], stamp=SECOND * 3 // 10))
    near_a = sweeps.at(SECOND * 12 // 100)
    assert near_a.points[:, 0] == pytest.approx([1.1])
    both = sweeps.at(SECOND * 21 // 100)
    assert both.points[:, 0] == pytest.approx([1.2, 10.0])
    assert both.seconds_later == {"/a": pytest.approx(-0.01), "/b": pytest.approx(0.09)}
    assert sweeps.at(SECOND) is None


def test_forgotten_sweeps_and_poses_are_those_no_later_stamp_needs(static):
    motion = driving(1.0)
    sweeps = LidarSweeps(["/lidar"], "base_link", static, motion)
    for tenths in range(10):
        sweeps.add("/lidar", cloud(stamp=tenths * SECOND // 10))
    stamp = SECOND * 55 // 100
    before, pose = sweeps.at(stamp).points, motion.base_pose(stamp)
    sweeps.forget_before(stamp)
    motion.forget_before(SECOND // 2)
    assert np.array_equal(sweeps.at(stamp).points, before)
    assert np.array_equal(motion.base_pose(stamp), pose)
    assert sweeps.at(SECOND // 5) is None
    with pytest.raises(TransformError, match="known from 500000000"):
        motion.base_pose(SECOND * 4 // 10)


def test_a_lidar_without_a_transform_is_named():
    sweeps = LidarSweeps(["/lidar"], "base_link", TransformTree(), None)
    with pytest.raises(TransformError, match=r"/lidar: no transform base_link <- lidar: frame '\w+' is unknown"):
        sweeps.add("/lidar", cloud())


def test_a_negative_tolerance_is_refused(static):
    with pytest.raises(ConfigError, match=r"-0\.1 s"):
        LidarSweeps([], "base_link", static, None, tolerance=-0.1)


def odometry(stamp: int, x: float) -> SimpleNamespace:
    position, orientation = SimpleNamespace(x=x, y=0.0, z=0.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=orientation))
    return SimpleNamespace(header=header(stamp, "odom"), child_frame_id="base_footprint", pose=pose)


def test_odometry_tells_the_motion_too(static):
    motion = VehicleMotion("/odom", PoseTrack("odom", "base_footprint"), static.lookup("base_footprint", "base_link"))
    motion.add(odometry(0, 1.0))
    motion.add(odometry(SECOND // 2, 3.0))
    assert motion.base_pose(SECOND // 4)[:3, 3] == pytest.approx([2.0, 0.5, 0.0])


@pytest.fixture(scope="module")
def sample():
    """The shipped recording's rig, LiDAR and motion."""
    with open_recording(SAMPLE) as recording:
        layout = discover_rig(recording)
        static = assemble_rig(recording, layout).transforms
        motion = VehicleMotion.find(recording, "base_link", static)
        sweeps = LidarSweeps(cloud_topics(recording), "base_link", static, motion)
        for message in recording.messages([motion.topic, *cloud_topics(recording)]):
            content = recording.deserialize(message)
            motion.add(content) if message.topic == motion.topic else sweeps.add(message.topic, content)
        topic = next(camera.image_topic for camera in layout.cameras if camera.name == "left")
        stamps = [recording.deserialize(m).header.stamp for m in recording.messages([topic])]
        yield layout.complete(), sweeps, motion, [stamp.sec * SECOND + stamp.nanosec for stamp in stamps]


def test_the_motion_of_the_sample_is_found_in_tf_and_is_that_of_a_driving_car(sample):
    _, _, motion, stamps = sample
    assert motion.topic == "/tf"
    travelled = np.linalg.norm((motion.base_pose(stamps[-1]) - motion.base_pose(stamps[0]))[:3, 3])
    assert 1.0 < travelled < 6.0  # in 0.9 s


def test_the_samples_lidar_as_prediction_has_no_error_in_any_camera(sample):
    rig, sweeps, _, stamps = sample
    scorer = SurroundScorer("sample", rig.names, ScoreSettings())
    for stamp in stamps[2:4]:
        images = []
        for camera in rig.cameras:
            truth = sparse_depth(sweeps.at(stamp).points, camera.rectified_view, OcclusionFilter())
            prediction = sample_prediction(truth.image(), truth)
            images.append(DepthSamples(prediction, truth.depth, np.zeros(len(truth), dtype=bool)))
        scorer.add(stamp, images)
    summary = scorer.scores().summary()
    for scores in summary.cameras.values():
        assert scores[ALL].truth > 500
        assert scores[ALL].coverage == 1.0
        assert scores[ALL].metrics["abs_rel"] < 1e-7  # the picture is float32
