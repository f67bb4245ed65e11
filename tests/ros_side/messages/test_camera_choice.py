# SPDX-License-Identifier: Apache-2.0
"""Which images are cameras' pictures, and which of several is taken."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import recordings
import small_rig
from recordings import Entry
from rosbags.rosbag2 import StoragePlugin
from small_rig import BEGIN, CLOUD, COMPRESSED, IMAGE, INFO, YAWS, compressed, raw

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.camera_discovery import FoundCameras, SeenTopic, find_cameras
from cvcdepth_ros.messages.cloud_sources import why_no_lidar
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras
from cvcdepth_ros.recordings.rig import discover_rig

NAMES = sorted(YAWS)


def grey16(bgr: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype(np.uint16) * 20


def depth(encoding: str):
    kind = np.float32 if encoding == "32FC1" else np.uint16
    return lambda time, frame, bgr: raw(time, frame, grey16(bgr).astype(kind), encoding)


def mono(time: int, frame: str, bgr: np.ndarray):
    return raw(time, frame, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), "mono8")


def packed_depth(time: int, frame: str, bgr: np.ndarray):
    png = cv2.imencode(".png", grey16(bgr))[1].tobytes()
    return small_rig.make(
        COMPRESSED,
        header=small_rig.header(time, frame),
        format="16UC1; png compressed",
        data=np.frombuffer(png, np.uint8),
    )


def found_in(path: Path) -> FoundCameras:
    with open_recording(path) as recording:
        return find_recorded_cameras(recording)


def find(tmp_path: Path, *parts: list[Entry]) -> FoundCameras:
    return found_in(small_rig.write_drive(tmp_path, small_rig.in_time(*parts)))


def topics(found: FoundCameras) -> list[str]:
    return [camera.image_topic for camera in found.cameras]


COLOUR = small_rig.entries("/{}/color/image_raw", IMAGE, raw, "/{}/color/camera_info")


@pytest.mark.parametrize(
    ("namespace", "encode", "type_"),
    [
        ("aligned_depth_to_color", depth("16UC1"), IMAGE),
        ("aligned_depth_to_infra1", depth("16UC1"), IMAGE),
        ("depth_registered", depth("32FC1"), IMAGE),
        ("depth_to_rgb", depth("mono16"), IMAGE),
        ("depth", depth("mono16"), IMAGE),
        ("stereo", depth("16UC1"), IMAGE),
        ("registered", depth("32FC1"), IMAGE),
        ("tof", packed_depth, COMPRESSED),
        ("segmentation", mono, IMAGE),
        ("semantic_segmentation", mono, IMAGE),
        ("disparity", mono, IMAGE),
    ],
)
@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_depth_images_and_masks_with_a_camera_info_are_no_cameras(namespace, encode, type_, storage, tmp_path: Path):
    others = small_rig.entries(f"/{{}}/{namespace}/image_raw", type_, encode, f"/{{}}/{namespace}/camera_info")
    drive = small_rig.in_time(COLOUR, [found for found in others if not found.topic.startswith("/tf")])
    found = found_in(recordings.write_rosbag2(tmp_path / "drive", drive, storage))
    assert topics(found) == [f"/{name}/color/image_raw" for name in NAMES]
    assert found.without_images == []
    assert any(f"/{NAMES[0]}/{namespace}/image_raw" in line for line in found.left_out)


RECTIFIED = small_rig.entries("/cams/{}/image_rect_color/compressed", info_topic="/cams/{}/camera_info")


@pytest.mark.parametrize(
    ("topic", "encode", "type_"),
    [
        ("debug/image_overlay/compressed", compressed, COMPRESSED),
        ("image_with_boxes", raw, IMAGE),
        ("detections/image", raw, IMAGE),
        ("image_annotated/compressed", compressed, COMPRESSED),
        ("segmentation/mask", mono, IMAGE),
        ("image_mask", mono, IMAGE),
        ("labels", mono, IMAGE),
        ("yolo/result_image", raw, IMAGE),
        ("traffic_light_roi", raw, IMAGE),
        ("depth/image_colormap", raw, IMAGE),
    ],
)
def test_what_was_drawn_or_measured_in_a_cameras_namespace_is_not_its_picture(topic, encode, type_, tmp_path: Path):
    found = find(tmp_path, RECTIFIED, small_rig.more_images(f"/cams/{{}}/{topic}", encode, type_))
    assert topics(found) == [f"/cams/{name}/image_rect_color/compressed" for name in NAMES]
    assert any(topic in line for line in [*found.choices, *found.left_out]), "it is told that there was a choice"


@pytest.mark.parametrize("other", ["image_raw", "image_rect_color"])
def test_a_stream_that_was_recorded_for_a_moment_only_is_not_taken(other: str, tmp_path: Path):
    drive = small_rig.entries(frames=8)
    found = find(tmp_path, drive, small_rig.more_images(f"/{{}}/{other}", raw, IMAGE, frames=2))
    assert topics(found) == [f"/{name}/image_raw/compressed" for name in NAMES]
    assert f"with 8 images, not /{NAMES[0]}/{other} (2)" in found.choices[0]


def test_a_stream_that_lost_a_few_images_is_still_taken(tmp_path: Path):
    drive = small_rig.entries(frames=12)
    found = find(tmp_path, drive, small_rig.more_images("/{}/image_raw", raw, IMAGE, frames=11))
    assert topics(found) == [f"/{name}/image_raw" for name in NAMES]


@pytest.mark.parametrize(
    ("rectified", "encode", "taken"),
    [
        ("image_rect_color", raw, True),
        ("image_rect", raw, True),
        ("image_rect", mono, False),
    ],
)
def test_rectified_colour_comes_before_raw_and_grey_does_not(rectified: str, encode, taken: bool, tmp_path: Path):
    drive = small_rig.entries("/{}/image_raw", IMAGE, raw)
    found = find(tmp_path, drive, small_rig.more_images(f"/{{}}/{rectified}", encode, IMAGE))
    chosen, other = (rectified, "image_raw") if taken else ("image_raw", rectified)
    assert topics(found) == [f"/{name}/{chosen}" for name in NAMES]
    assert [camera.rectified for camera in found.cameras] == [taken] * 3
    why = "rectified, in colour, raw" if taken else "not rectified yet, in colour, raw"
    assert found.choices[0] == (f"camera {NAMES[0]}: /{NAMES[0]}/{chosen} is taken ({why}), not /{NAMES[0]}/{other}")


def test_of_two_namespaces_with_one_frame_the_rectified_one_is_taken_and_the_other_told(tmp_path: Path):
    rectified = small_rig.entries("/{}/image_rect_color", IMAGE, raw)
    unrectified = small_rig.entries("/{}_raw/image_raw_color", IMAGE, raw, "/{}_raw/camera_info")
    found = find(tmp_path, rectified, [entry for entry in unrectified if not entry.topic.startswith("/tf")])
    assert topics(found) == [f"/{name}/image_rect_color" for name in NAMES]
    assert any(
        "/port_raw/image_raw_color is left out: /port/image_rect_color has the same frame" in line
        for line in found.left_out
    )


def test_what_the_node_published_while_it_was_recorded_is_no_camera(tmp_path: Path):
    node = "/surround_depth/{}"
    depths = small_rig.entries(f"{node}/depth/image_rect", IMAGE, depth("32FC1"), f"{node}/depth/camera_info")
    pictures = small_rig.entries(f"{node}/image_rect", IMAGE, raw, f"{node}/camera_info")
    own = [entry for entry in (*depths, *pictures) if not entry.topic.startswith("/tf")]
    assert topics(find(tmp_path, small_rig.entries(), own)) == [f"/{name}/image_raw/compressed" for name in NAMES]


def test_the_other_camera_of_a_stereo_pair_has_no_place_of_its_own():
    infos = {"/rig/left/camera_info": INFO, "/rig/right/camera_info": INFO, "/back/camera_info": INFO}
    images = {"/rig/left/image_raw": IMAGE, "/rig/right/image_raw": IMAGE, "/back/image_raw": IMAGE}
    seen = {topic: SeenTopic(9, "bgr8", "eyes", "right" in topic) for topic in (*infos, *images)}
    seen |= {topic: SeenTopic(9, "bgr8", "back") for topic in ("/back/camera_info", "/back/image_raw")}
    assert [camera.name for camera in find_cameras({**infos, **images}, seen).cameras] == ["back", "left"]


def test_where_all_cameras_claim_one_frame_none_is_dropped():
    topic_types = {
        f"/{name}/{topic}": type_ for name in "abc" for topic, type_ in (("image", IMAGE), ("camera_info", INFO))
    }
    seen = {topic: SeenTopic(9, "bgr8", "camera") for topic in topic_types}
    assert len(find_cameras(topic_types, seen).cameras) == 3


STRAYS = ["/cam/camera_info", "/camera_info"]


@pytest.mark.parametrize("stray", STRAYS)
def test_a_camera_info_above_the_cameras_claims_no_images(stray: str, tmp_path: Path):
    drive = small_rig.entries("/cam/{}/image_raw/compressed", info_topic="/cam/{}/camera_info")
    extra = small_rig.entry(stray, INFO, BEGIN, small_rig.info(BEGIN, "ahead_optical"))
    with open_recording(small_rig.write_drive(tmp_path, small_rig.in_time(drive, [extra]))) as recording:
        found = find_recorded_cameras(recording)
        assert len(discover_rig(recording).cameras) == 3
    assert (found.without_images, found.without_info) == ([], [])
    assert any(line.startswith(f"{stray} is of no camera") for line in found.left_out)


@pytest.mark.parametrize("name", ["calib_info", "info", "camera_info_raw"])
def test_a_camera_info_of_another_name_is_offered(name: str, tmp_path: Path):
    drive = small_rig.entries("/usb_{}/image_raw", IMAGE, raw, f"/usb_{{}}/{name}")
    with open_recording(small_rig.write_drive(tmp_path, drive)) as recording:
        assert find_recorded_cameras(recording).cameras == []
        with pytest.raises(RecordingError, match=f"found 0.*did you mean .*/usb_ahead/{name}"):
            discover_rig(recording)


@pytest.mark.parametrize("stray", STRAYS)
def test_a_stray_camera_info_does_not_hide_those_of_other_names(stray: str, tmp_path: Path):
    drive = small_rig.entries("/cam/{}/image_raw/compressed", info_topic="/cam/{}/calib_info")
    extra = small_rig.entry(stray, INFO, BEGIN, small_rig.info(BEGIN, "ahead_optical"))
    found = find(tmp_path, drive, [extra])
    assert found.cameras == []
    assert "did you mean /cam/ahead/calib_info" in found.offers


def test_one_odd_name_among_three_is_offered_for_its_own_images(tmp_path: Path):
    drive = [
        entry._replace(topic="/port/calib_info") if entry.topic == "/port/camera_info" else entry
        for entry in small_rig.entries()
    ]
    found = find(tmp_path, drive)
    assert [camera.name for camera in found.cameras] == ["ahead", "starboard"]
    assert found.similar_infos == {"/port/image_raw/compressed": "/port/calib_info"}


def cloud(*fields: str):
    field = "sensor_msgs/msg/PointField"
    described = [small_rig.make(field, name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(fields)]
    return small_rig.make(
        CLOUD,
        header=small_rig.header(BEGIN, "f"),
        height=1,
        width=0,
        fields=described,
        is_bigendian=False,
        point_step=4 * len(fields),
        row_step=0,
        data=np.zeros(0, np.uint8),
        is_dense=True,
    )


@pytest.mark.parametrize(
    ("topic", "fields", "reason"),
    [
        ("/front/points", "x y z doppler rcs", "their points have doppler, rcs, as a radar's"),
        ("/front/points", "x y z dyn_prop id rcs vx vy vx_comp vy_comp", "as a radar's"),
        ("/front/points", "x y z range_rate", "as a radar's"),
        ("/RADAR_FRONT", "x y z", "their name is a radar's or sonar's"),
        ("/ars408/objects_cloud", "x y z", "their name is a radar's or sonar's"),
        ("/perception/obstacle_segmentation/pointcloud", "x y z", "their name is that of obstacles"),
        ("/euclidean_cluster/points", "x y z intensity", "their name is that of obstacles"),
        ("/points_no_ground", "x y z intensity", "their name is that of obstacles"),
        ("/map/pointcloud_map", "x y z", "their name is a map's"),
        ("/front/depth/points", "x y z", "their name is a depth camera's"),
        ("/front/points", "x y z rgb", "their points have colours"),
        ("/lidar/points", "x y z intensity ring time", None),
        ("/velodyne_points", "x y z intensity", None),
        ("/fmcw/lidar", "x y z velocity intensity", None),
        ("/mapping_vehicle/livox", "x y z tag line", None),
    ],
)
def test_a_radars_or_obstacles_cloud_is_no_lidars(topic: str, fields: str, reason: str | None):
    found = why_no_lidar(topic, cloud(*fields.split()))
    assert found is None if reason is None else reason in (found or "")
