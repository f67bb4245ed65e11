# SPDX-License-Identifier: Apache-2.0
"""The node as its users meet it: a process that is fed and read over DDS."""

import copy
import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from repository import ROOT

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from faults.table import NODE
from geometry_msgs.msg import TransformStamped
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import deserialize_message
from recordings import CAMERAS, JAZZY, sample_entries
from ros_graph import RosGraph, best_effort, reliable
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, LaserScan, PointCloud2
from std_msgs.msg import Header

from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec

# The engine that is there at once: another takes a second to convert the network and compare it.
SMALL = {"untrained": True, "height": 96, "width": 160, "max_age": 0.0, "backend": "torch_eager"}
FIRING_ORDER = ("back", "left", "front_left", "front", "front_right", "right")


@pytest.fixture(scope="module")
def messages() -> dict[str, list[Any]]:
    """The sample's messages by topic, as rclpy's objects (transforms as rosbags')."""
    classes = {"sensor_msgs/msg/CompressedImage": CompressedImage, "sensor_msgs/msg/CameraInfo": CameraInfo}
    found: dict[str, list[Any]] = {}
    for entry in sample_entries():
        if entry.type in classes:
            found.setdefault(entry.topic, []).append(deserialize_message(entry.cdr, classes[entry.type]))
        elif entry.topic == "/tf_static":
            found.setdefault(entry.topic, []).append(JAZZY.deserialize_cdr(entry.cdr, entry.type))
    return found


@pytest.fixture
def rig_content(messages: dict[str, list[Any]]) -> dict[str, Any]:
    """A rig file's content for the sample, written by hand: intrinsics from CameraInfo, poses from /tf_static."""
    poses = {t.child_frame_id: t.transform for t in messages["/tf_static"][0].transforms}
    cameras = []
    for name in CAMERAS:
        pose = poses[f"{name}_camera_optical_frame"]
        cameras.append(
            {
                "name": name,
                "image_topic": f"/camera/{name}/image_raw/compressed",
                "camera_info_topic": f"/camera/{name}/camera_info",
                "frame_id": f"{name}_camera_optical_frame",
                "base_T_camera": {
                    "translation": [pose.translation.x, pose.translation.y, pose.translation.z],
                    "rotation": [pose.rotation.x, pose.rotation.y, pose.rotation.z, pose.rotation.w],
                },
            }
        )
    return {"base_frame": "base_link", "cameras": cameras}


def write_rig(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


class Feed:
    """Publishes the sample's images and camera_info, one set after the other."""

    def __init__(self, graph: RosGraph, messages: dict[str, list[Any]], qos: Any = None) -> None:
        self._graph, self._messages = graph, messages
        topics = [topic for topic in messages if topic.startswith("/camera/")]
        self._publishers = {
            topic: graph.node.create_publisher(type(messages[topic][0]), topic, qos or reliable()) for topic in topics
        }

    def publish(self, index: int) -> None:
        """Publish the set with this index, the cameras in the order in which they fired."""
        for topic in [
            f"/camera/{name}/{kind}" for name in FIRING_ORDER for kind in ("camera_info", "image_raw/compressed")
        ]:
            if topic in self._publishers:
                self._publishers[topic].publish(self._messages[topic][index])

    def publish_until(self, condition: Any, what: str) -> None:
        """Publish the ten sets again and again, ten a second at most, until the condition holds."""
        indices = iter(range(10**6))

        def step() -> bool:
            self.publish(next(indices) % 10)
            self._graph.spin(0.1)
            return bool(condition())

        self._graph.spin_until(step, what)


def start_and_connect(graph: RosGraph, rig: Path, feed: Feed, **parameters: Any) -> None:
    graph.start_node(rig=rig, **(SMALL | parameters))
    graph.await_subscribers([f"/camera/{name}/image_raw/compressed" for name in CAMERAS])


def test_a_stranger_rebuilds_the_organised_cloud_from_depth_and_camera_info(graph, messages, rig_content, tmp_path):
    feed = Feed(graph, messages)
    kinds = {"depth/image_rect": Image, "depth/camera_info": CameraInfo, "points": PointCloud2, "image_rect": Image}
    topics = {(name, kind): f"/surround_depth/{name}/{kind}" for name in CAMERAS for kind in kinds}
    for (_, kind), topic in topics.items():
        graph.subscribe(kinds[kind], topic)
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed)
    feed.publish_until(lambda: all(graph.received[topic] for topic in topics.values()), "every output of every camera")

    for name in CAMERAS:
        first = {kind: graph.received[topics[name, kind]][0] for kind in kinds}
        depth, info, cloud, picture = (first[kind] for kind in kinds)
        stamps = {
            (m.header.stamp.sec, m.header.stamp.nanosec) for m in messages[f"/camera/{name}/image_raw/compressed"]
        }
        assert (depth.header.stamp.sec, depth.header.stamp.nanosec) in stamps
        assert depth.header == info.header == cloud.header == picture.header
        assert depth.header.frame_id == f"{name}_camera_optical_frame"
        assert (depth.encoding, picture.encoding) == ("32FC1", "rgb8")
        size = (info.height, info.width)
        assert size == (depth.height, depth.width) == (cloud.height, cloud.width) == (picture.height, picture.width)

        metres = np.frombuffer(depth.data, np.float32).reshape(size)
        metres = np.where(np.isfinite(metres), metres, np.nan)  # the sky is inf
        points = np.frombuffer(cloud.data, np.float32).reshape(*size, cloud.point_step // 4)
        fx, _, cx, _, _, fy, cy, *_ = info.p
        v, u = np.mgrid[: info.height, : info.width]
        # depth_image_proc's formula.
        expected = np.stack([(u - cx) * metres / fx, (v - cy) * metres / fy, metres], axis=-1)
        assert np.isfinite(metres).mean() > 0.99
        np.testing.assert_allclose(points[..., :3], expected, atol=1e-3)
        colours = np.frombuffer(picture.data, np.uint8).reshape(*size, 3)
        packed = points[..., 3].copy().view(np.uint32)
        np.testing.assert_array_equal(packed >> 16, colours[..., 0])
        np.testing.assert_array_equal(packed & 0xFF, colours[..., 2])


def test_the_merged_cloud_is_in_the_base_frame_with_the_anchors_stamp(graph, messages, rig_content, tmp_path):
    feed = Feed(graph, messages)
    graph.subscribe(PointCloud2, "/surround_depth/points")
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed, cloud_stride=4, cloud_max_range=40.0)
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "a merged cloud")
    cloud = graph.received["/surround_depth/points"][0]
    anchors = [message.header.stamp for message in messages["/camera/front/image_raw/compressed"]]
    assert cloud.header.stamp in anchors
    assert cloud.header.frame_id == "base_link"
    assert cloud.height == 1
    assert 0 < cloud.width <= 6 * 24 * 40
    points = np.frombuffer(cloud.data, np.float32).reshape(-1, 4)[:, :3]
    assert np.isfinite(points).all()
    # All around the vehicle: some points in each quadrant of the base frame.
    quadrants = {(x > 0, y > 0) for x, y in points[:, :2]}
    assert len(quadrants) == 4


def test_obstacles_ground_and_scan_come_to_whoever_subscribes_and_the_ground_is_told(
    graph, messages, rig_content, tmp_path
):
    feed = Feed(graph, messages)
    kinds = {"obstacles": PointCloud2, "ground": PointCloud2, "scan": LaserScan}
    for kind, type_ in kinds.items():
        graph.subscribe(type_, f"/surround_depth/{kind}")
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed, cloud_deskew=True, scan_resolution=1.0)
    feed.publish_until(lambda: all(graph.received[f"/surround_depth/{kind}"] for kind in kinds), "what drivers need")
    scan = graph.received["/surround_depth/scan"][0]
    assert scan.header.frame_id == "base_link"
    ranges = np.array(scan.ranges, np.float32)
    assert len(ranges) == 360
    known = ranges[np.isfinite(ranges)]
    assert ((known >= scan.range_min) & (known <= scan.range_max)).all()
    for kind in ("obstacles", "ground"):
        cloud = graph.received[f"/surround_depth/{kind}"][0]
        assert len(cloud.data) == cloud.width * cloud.point_step
        assert np.isfinite(np.frombuffer(cloud.data, np.float32).reshape(-1, 4)[:, :3]).all()
    feed.publish_until(lambda: graph.values("ground plane") and graph.values("deskew") is not None, "its diagnostics")
    assert "height (m)" in graph.values("ground plane")


def test_depth_in_millimetres_is_the_depth_in_metres(graph, messages, rig_content, tmp_path):
    feed = Feed(graph, messages)
    topic = "/surround_depth/front/depth/image_rect"
    graph.subscribe(Image, topic)
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed, depth_encoding="16UC1")
    feed.publish_until(lambda: graph.received[topic], "a depth image")
    depth = graph.received[topic][0]
    assert depth.encoding == "16UC1"
    assert depth.step == 2 * depth.width
    millimetres = np.frombuffer(depth.data, np.uint16)
    assert 100 < np.median(millimetres) < 65535


def test_nothing_is_inferred_while_nobody_subscribes(graph, messages, rig_content, tmp_path):
    feed = Feed(graph, messages)
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed)
    feed.publish_until(lambda: int(graph.values("synchronisation").get("skipped: no subscriber", 0)) > 3, "idle sets")
    assert graph.values("synchronisation")["published"] == "0"


def test_the_rig_is_found_among_the_live_topics(graph, messages):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    feed = Feed(graph, messages)
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    transforms.publish(transform_message(tf2_msgs, messages))
    graph.subscribe(PointCloud2, "/surround_depth/points")
    graph.start_node(rig="auto", **SMALL)
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "a merged cloud")
    assert "rig auto: front, front_left, left, back, right, front_right" in graph.log()


def test_a_rig_that_was_found_follows_later_calibrations(graph, messages):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    spoiled = dict(messages)
    info = "/camera/left/camera_info"
    feed = Feed(graph, spoiled)
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    transforms.publish(transform_message(tf2_msgs, messages))
    graph.subscribe(PointCloud2, "/surround_depth/points")
    graph.start_node(rig="auto", min_cameras=4, **SMALL)
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "a merged cloud")
    spoiled[info] = copy.deepcopy(messages[info])
    for message in spoiled[info]:
        set_k_to_zero(message)
    feed.publish_until(lambda: "K[0] = 0" in message_of(graph, "camera left"), "the refusal")


def test_one_camera_is_a_rig_too_after_it_has_been_alone_for_a_while(graph, messages):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    feed = Feed(graph, {topic: found for topic, found in messages.items() if topic.startswith("/camera/left/")})
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    transforms.publish(transform_message(tf2_msgs, messages))
    graph.subscribe(PointCloud2, "/surround_depth/points")
    graph.start_node(rig="auto", **SMALL)
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "a cloud")
    graph.await_status("cross-view consistency", "ok")


def test_a_rig_is_not_settled_on_with_fewer_cameras_than_are_asked_for(graph, messages):
    pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    two = {topic: found for topic, found in messages.items() if topic.startswith(("/camera/front/", "/camera/left/"))}
    feed = Feed(graph, two)
    graph.start_node(rig="auto", min_cameras=4, **SMALL)
    feed.publish_until(lambda: "found front, left" in message_of(graph, "node"), "both")
    assert "waiting for at least 4 cameras" in message_of(graph, "node")


def test_a_found_rig_that_cannot_be_started_says_why_and_is_tried_again(graph, messages, tmp_path):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    feed = Feed(graph, messages)
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    transforms.publish(transform_message(tf2_msgs, messages))
    graph.subscribe(PointCloud2, "/surround_depth/points")
    trace = tmp_path / "later" / "trace.json"
    graph.start_node(rig="auto", trace=trace, **SMALL)
    feed.publish_until(lambda: str(trace) in message_of(graph, "node"), "the reason")
    trace.parent.mkdir()
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "a merged cloud")


def test_image_topics_may_be_relative_and_remapped(graph, messages, rig_content, tmp_path):
    feed = Feed(graph, messages)
    rig_content["cameras"][2]["image_topic"] = "left/pictures"
    graph.subscribe(Image, "/surround_depth/left/depth/image_rect")
    remapping = ("-r", "left/pictures:=/camera/left/image_raw/compressed")
    graph.start_node(*remapping, rig=write_rig(tmp_path, rig_content), **SMALL)
    feed.publish_until(lambda: graph.received["/surround_depth/left/depth/image_rect"], "depth")


def test_an_impossible_image_topic_is_named(graph, rig_content, tmp_path):
    rig_content["cameras"][2]["image_topic"] = "left pictures"
    graph.start_node(rig=write_rig(tmp_path, rig_content), **SMALL)
    graph.await_status("node", "image_topic 'left pictures'")


def test_a_camera_that_is_renamed_and_one_that_is_moved_are_followed(graph, messages, rig_content, tmp_path):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    for camera in rig_content["cameras"]:
        del camera["base_T_camera"], camera["frame_id"]
    info, cloud = "/camera/left/camera_info", "/surround_depth/points"
    renamed = dict(messages)
    renamed[info] = copy.deepcopy(messages[info])
    for message in renamed[info]:
        message.header.frame_id = "camera"
    feed = Feed(graph, renamed)
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    fixed = transform_message(tf2_msgs, messages)
    transforms.publish(fixed)
    graph.subscribe(PointCloud2, cloud)
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed)
    feed.publish_until(lambda: "'camera' is unknown" in message_of(graph, "camera left"), "the missing transform")
    renamed[info][:] = messages[info]
    feed.publish_until(lambda: graph.received[cloud], "a cloud once the frame is right")

    for transform in fixed.transforms:
        transform.transform.translation.z += 500.0
    transforms.publish(fixed)
    feed.publish_until(lambda: height_of(graph.received[cloud][-1]) > 300, "a cloud from above")


def height_of(cloud: PointCloud2) -> float:
    return float(np.median(np.frombuffer(cloud.data, np.float32).reshape(-1, 4)[:, 2]))


def test_a_missing_transform_is_named_and_awaited(graph, messages, rig_content, tmp_path):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    for camera in rig_content["cameras"]:
        del camera["base_T_camera"]
    feed = Feed(graph, messages)
    graph.subscribe(Image, "/surround_depth/front/depth/image_rect")
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed)
    feed.publish_until(lambda: int(graph.values("synchronisation").get("matched", 0)), "a matched set")
    graph.await_status("camera left", "left_camera_optical_frame")
    assert not graph.received["/surround_depth/front/depth/image_rect"]
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    transforms.publish(transform_message(tf2_msgs, messages))
    feed.publish_until(
        lambda: graph.received["/surround_depth/front/depth/image_rect"], "depth once the poses are there"
    )


def test_transforms_that_make_no_tree_are_refused_by_name_and_the_others_taken(graph, messages, fault_table):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
    good = transform_message(tf2_msgs, messages)
    links = [("turntable", "turntable"), ("base_link", "rack"), ("rack", "base_link"), ("base_link", "n" * 300)]
    bad = [TransformStamped(child_frame_id=child, header=Header(frame_id=parent)) for parent, child in links]
    bad += copy.deepcopy([good.transforms[0]] * 2)
    bad[-2].transform.rotation.w, bad[-2].child_frame_id = 7.0, "stretched"
    bad[-1].transform.translation.x, bad[-1].child_frame_id = float("nan"), "nowhere"
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    # The transforms are there before the cameras, and again after them.
    graph.start_node(rig="auto", **SMALL)
    graph.await_status("node", "rig auto")
    begin = time.monotonic()
    transforms.publish(tf2_msgs.TFMessage(transforms=[*bad, *good.transforms]))
    graph.spin_until(lambda: "transform turntable <- turntable closes a loop" in graph.log(), "the loop in the log")
    told = time.monotonic() - begin
    fault_table.add(
        "transforms in loops, no numbers, no rotations", NODE, "named in the log; the others are used", told
    )
    feed = Feed(graph, messages)
    graph.subscribe(PointCloud2, "/surround_depth/points")
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "a merged cloud")
    transforms.publish(tf2_msgs.TFMessage(transforms=[*bad, *good.transforms]))
    graph.received["/surround_depth/points"].clear()
    feed.publish_until(lambda: graph.received["/surround_depth/points"], "another cloud")
    assert "Traceback" not in graph.log()


def transform_message(tf2_msgs: Any, messages: dict[str, list[Any]]) -> Any:
    recorded = messages["/tf_static"][0]
    cdr = bytes(JAZZY.serialize_cdr(recorded, "tf2_msgs/msg/TFMessage"))
    return deserialize_message(cdr, tf2_msgs.TFMessage)


def set_k_to_zero(info: CameraInfo) -> None:
    info.k = np.zeros(9)


def set_model(info: CameraInfo) -> None:
    info.distortion_model = "kannala_brandt_17"


def set_size(info: CameraInfo) -> None:
    info.width, info.height = 1920, 1080


@pytest.mark.parametrize(
    ("spoil", "subject", "text"),
    [
        (set_k_to_zero, "camera left", "K[0] = 0: the camera is not calibrated"),
        (set_model, "camera left", "kannala_brandt_17"),
        (set_size, "camera left", "rejected: image of 960x540, but its camera_info says 1920x1080"),
    ],
)
def test_an_impossible_camera_info_is_named_and_awaited(spoil, subject, text, graph, messages, rig_content, tmp_path):
    spoiled = dict(messages)
    info = "/camera/left/camera_info"
    spoiled[info] = [deserialize_message(e.cdr, CameraInfo) for e in sample_entries() if e.topic == info]
    for message in spoiled[info]:
        spoil(message)
    feed = Feed(graph, spoiled)
    depth = "/surround_depth/left/depth/image_rect"
    graph.subscribe(Image, depth)
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed)
    feed.publish_until(lambda: text in message_of(graph, subject), f"'{text}'")
    assert not graph.received[depth]
    spoiled[info][:] = messages[info]
    feed.publish_until(lambda: graph.received[depth], "depth once camera_info is right")


def message_of(graph: RosGraph, subject: str) -> str:
    status = graph.statuses.get(f"surround_depth: {subject}")
    return status.message if status else ""


def test_an_unknown_encoding_is_named(graph, messages, rig_content, tmp_path):
    raw = dict(messages)
    del raw["/camera/left/image_raw/compressed"]
    rig_content["cameras"][2]["image_topic"] = "/camera/left/image_raw"
    publisher = graph.node.create_publisher(Image, "/camera/left/image_raw", reliable())
    feed = Feed(graph, raw)
    graph.subscribe(Image, "/surround_depth/left/depth/image_rect")
    graph.start_node(rig=write_rig(tmp_path, rig_content), **SMALL)
    graph.await_subscribers(["/camera/left/image_raw"])

    def refused() -> bool:
        for message in messages["/camera/left/image_raw/compressed"]:
            image = Image(header=message.header, height=540, width=960, encoding="yuv444", step=1920)
            publisher.publish(image)
        return "encoding 'yuv444' is not supported" in message_of(graph, "camera left")

    feed.publish_until(refused, "the refusal")


def test_a_topic_without_publisher_is_named(graph, messages, rig_content, tmp_path):
    without = {topic: found for topic, found in messages.items() if not topic.startswith("/camera/left/")}
    Feed(graph, without)
    graph.start_node(rig=write_rig(tmp_path, rig_content), **SMALL)
    graph.await_status("camera left", "no publisher on /camera/left/image_raw/compressed")
    graph.await_status("camera front", "waiting for camera_info on /camera/front/camera_info")


def test_a_publisher_whose_qos_does_not_match_is_named(graph, messages, rig_content, tmp_path):
    Feed(graph, messages, best_effort())
    graph.start_node(rig=write_rig(tmp_path, rig_content), reliable=True, **SMALL)
    status = graph.await_status("camera left", "QoS does not match")
    assert "Best effort publisher and reliable subscription" in status.message
    assert "/camera/left/" in status.message


def test_qos_overrides_make_a_single_topic_match(graph, messages, rig_content, tmp_path):
    feed = Feed(graph, messages, best_effort())
    graph.subscribe(Image, "/surround_depth/front/depth/image_rect")
    overrides = {
        f"qos_overrides./camera/{name}/{topic}.subscription.reliability": "best_effort"
        for name in CAMERAS
        for topic in ("camera_info", "image_raw/compressed")
    }
    output = {"qos_overrides./surround_depth/left/points.publisher.reliability": "best_effort"}
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed, reliable=True, **overrides, **output)
    feed.publish_until(lambda: graph.received["/surround_depth/front/depth/image_rect"], "depth")

    def reliability(topic: str) -> Any:
        return graph.node.get_publishers_info_by_topic(topic)[0].qos_profile.reliability

    assert reliability("/surround_depth/left/points") == ReliabilityPolicy.BEST_EFFORT
    assert reliability("/surround_depth/back/points") == ReliabilityPolicy.RELIABLE


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"untrained": True, "rig": "''"}, "parameter rig is empty"),
        ({"rig": "RIG", "untrained": True, "checkpoint": "model.safetensors"}, "a checkpoint is trained; name none"),
        ({"rig": "/nowhere/rig.yaml", "untrained": True}, "rig file /nowhere/rig.yaml: cannot be read"),
        ({"rig": "RIG", "checkpoint": "/nowhere/model.safetensors"}, "/nowhere/model.safetensors: no such file"),
        ({"rig": "RIG", "checkpoint": "DAMAGED"}, "is damaged or not a safetensors file"),
        ({"rig": "RIG", "untrained": True, "encoder": "vgg"}, "parameter encoder: expected one of resnet18, resnet34"),
        ({"rig": "RIG", "untrained": True, "device": "abacus"}, "device: 'abacus' is not available"),
        ({"rig": "NO_CAMERA", "untrained": True}, "a rig needs at least one camera, found none"),
    ],
)
def test_what_cannot_start_is_one_line_and_a_diagnostic(parameters, reason, graph, rig_content, tmp_path):
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"\xff" * 64)
    none = tmp_path / "none"
    none.mkdir()
    files = {
        "RIG": write_rig(tmp_path, rig_content),
        "NO_CAMERA": write_rig(none, rig_content | {"cameras": []}),
        "DAMAGED": damaged,
    }
    graph.start_node(**{name: files.get(str(value), value) for name, value in parameters.items()})
    graph.await_status("node", reason)
    assert "Traceback" not in graph.log()
    assert len([line for line in graph.log().splitlines() if "[ERROR]" in line]) == 1


def test_parameters_say_what_they_refuse(graph, rig_content, tmp_path):
    graph.start_node(rig=write_rig(tmp_path, rig_content), **SMALL)
    graph.await_status("node", "active")
    assert graph.set_parameters(cloud_max_range=25.0)[0].successful
    assert "clean the node up first" in graph.set_parameters(tolerance=0.2)[0].reason
    assert "out of range" in graph.set_parameters(cloud_stride=1000)[0].reason


def small_checkpoint(path: Path, seed: int) -> str:
    torch.manual_seed(seed)
    spec = DepthModelSpec(encoder="efficientnet_lite0", height=64, width=96, min_depth=1.0, max_depth=50.0)
    save_checkpoint(path, spec, DepthNet(spec.encoder).state_dict())
    return str(path)


def test_another_checkpoint_is_loaded_while_running_and_a_bad_one_is_refused(graph, messages, rig_content, tmp_path):
    first, second = (small_checkpoint(tmp_path / f"{seed}.safetensors", seed) for seed in (1, 2))
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"\xff" * 64)
    topic = "/surround_depth/front/depth/image_rect"
    feed = Feed(graph, messages)
    graph.subscribe(Image, topic)
    graph.start_node(rig=write_rig(tmp_path, rig_content), checkpoint=first, max_age=0.0)
    graph.await_subscribers([f"/camera/{name}/image_raw/compressed" for name in CAMERAS])
    feed.publish_until(lambda: graph.received[topic], "depth of the first network")

    (refused,) = graph.set_parameters(checkpoint=str(damaged))
    assert not refused.successful
    assert "is damaged or not a safetensors file" in refused.reason
    assert "1.safetensors" in graph.await_status("model", "safetensors").message

    assert graph.set_parameters(checkpoint=second)[0].successful
    graph.await_status("model", "2.safetensors")
    former = bytes(graph.received[topic][0].data)
    graph.received[topic].clear()
    feed.publish_until(lambda: graph.received[topic], "depth of the second network")
    assert bytes(graph.received[topic][-1].data) != former


def test_old_sets_are_dropped_and_counted_when_ros_time_has_moved_on(graph, messages, rig_content, tmp_path):
    """The sample was recorded in 2019; without simulated time its sets are years old."""
    feed = Feed(graph, messages)
    graph.subscribe(Image, "/surround_depth/front/depth/image_rect")
    start_and_connect(graph, write_rig(tmp_path, rig_content), feed, max_age=1.0)
    feed.publish_until(
        lambda: "every set is older than max_age (1 s)" in message_of(graph, "synchronisation"), "a warning"
    )
    assert int(graph.values("synchronisation")["stale"]) >= 1
    assert not graph.received["/surround_depth/front/depth/image_rect"]


def test_full_size_raw_images_at_ten_hertz_are_not_lost(graph, messages, rig_content, tmp_path):
    size, sets = (1080, 1920), 10
    infos, images, publishers = {}, {}, {}
    for camera in rig_content["cameras"]:
        name = camera["name"]
        camera["image_topic"] = f"/camera/{name}/image_raw"
        info = deserialize_message(
            next(e.cdr for e in sample_entries(1) if e.topic == camera["camera_info_topic"]), CameraInfo
        )
        info.width, info.height, info.k = size[1], size[0], [*(2 * info.k[:6]), 0.0, 0.0, 1.0]
        info.p = np.zeros(12)
        infos[name] = info
        images[name] = Image(height=size[0], width=size[1], encoding="bgr8", step=3 * size[1])
        images[name].data.frombytes(np.full((*size, 3), 90, np.uint8).tobytes())
        publishers[name] = (
            graph.node.create_publisher(CameraInfo, camera["camera_info_topic"], reliable()),
            graph.node.create_publisher(Image, camera["image_topic"], reliable(sets)),
        )
    # Best effort, or a publisher that keeps fewer images, loses nothing on a quiet machine either; a test must not
    # depend on what else runs.
    graph.start_node(rig=write_rig(tmp_path, rig_content), reliable=True, frozen_after=0.0, **SMALL)
    graph.subscribe(Image, "/surround_depth/front/depth/image_rect")
    graph.await_matches(itertools.chain.from_iterable(publishers.values()))

    def calibrated() -> bool:
        for name in CAMERAS:
            publishers[name][0].publish(infos[name])
        graph.spin(0.1)
        return all(message_of(graph, f"camera {name}") == "waiting for images: no image yet" for name in CAMERAS)

    graph.spin_until(calibrated, "every calibration")
    start, now = time.monotonic(), time.time_ns()
    for index in range(sets):
        for offset, name in enumerate(FIRING_ORDER):
            nanoseconds = now + index * 10**8 + offset * 16 * 10**6
            for message in (infos[name], images[name]):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
                message.header.frame_id = f"{name}_camera_optical_frame"
            publishers[name][0].publish(infos[name])
            publishers[name][1].publish(images[name])
            graph.spin(max(0.0, start + index * 0.1 + (offset + 1) * 0.016 - time.monotonic()))
    graph.spin_until(
        lambda: all(graph.values(f"camera {name}").get("received") == str(sets) for name in CAMERAS), "every image"
    )
    age = "age of newest image at publish (ROS time) p50 (ms)"
    graph.spin_until(lambda: age in graph.values("inference"), "a published set")
    assert {graph.values(f"camera {name}")["lost in transport"] for name in CAMERAS} == {"0"}
    assert graph.values("synchronisation")["matched"] == str(sets)
    assert float(graph.values("inference")[age]) > 0


def test_the_parameter_file_lists_every_parameter_with_its_default(graph):
    from cvcdepth_ros.settings import NodeParameters

    content = yaml.safe_load((ROOT / "config" / "surround_depth.yaml").read_text())["/**"]["ros__parameters"]
    defaults = {name: field.default for name, field in NodeParameters.model_fields.items()}
    assert content == defaults
    graph.start_node("--params-file", str(ROOT / "config" / "surround_depth.yaml"), "-p", "untrained:=true")
    graph.spin_until(lambda: "node" in str(graph.statuses), "diagnostics")
    assert "rig auto" in message_of(graph, "node") or "tf2_msgs" in message_of(graph, "node")
