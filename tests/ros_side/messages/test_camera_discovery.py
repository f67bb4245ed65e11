# SPDX-License-Identifier: Apache-2.0
import pytest

from cvcdepth_ros.messages.camera_discovery import discover_cameras

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
VIDEO = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"


def topics(*namespaces: str, **images: str) -> dict[str, str]:
    """camera_info for each namespace, and in each the given image topics (`/` written as `__`)."""
    found = {f"{namespace}/camera_info": "sensor_msgs/msg/CameraInfo" for namespace in namespaces}
    return found | {
        f"{namespace}/{name.replace('__', '/')}": type_name
        for namespace in namespaces
        for name, type_name in images.items()
    }


@pytest.mark.parametrize(
    ("namespaces", "names"),
    [
        (["/camera/left", "/camera/front_left"], {"left", "front_left"}),
        (["/front/camera", "/back/camera"], {"front_camera", "back_camera"}),
        (["/sensors/0", "/sensors/1"], {"camera_0", "camera_1"}),
        ([""], {"camera"}),
        (["/front-left", "/é", "/a\0b"], {"front_left", "camera", "a_b"}),
        (["/a-b", "/a_b"], {"a_b_0", "a_b_1"}),
    ],
)
def test_cameras_are_called_by_the_shortest_names_that_tell_them_apart(namespaces, names):
    assert {camera.name for camera in discover_cameras(topics(*namespaces, image_raw=RAW))} == names


@pytest.mark.parametrize(
    ("images", "chosen", "rectified"),
    [
        ({"image_raw": RAW, "image_raw__compressed": COMPRESSED, "image_rect": RAW}, "/cam/image_raw", False),
        ({"image_raw__compressed": COMPRESSED, "image_rect": RAW}, "/cam/image_rect", True),
        ({"image_rect_compressed": COMPRESSED}, "/cam/image_rect_compressed", True),
        (
            {"image_raw__compressed": COMPRESSED, "image_raw__compressedDepth": COMPRESSED},
            "/cam/image_raw/compressed",
            False,
        ),
        ({"image_raw__ffmpeg": VIDEO, "image_raw__compressed": COMPRESSED}, "/cam/image_raw/compressed", False),
        ({"image_raw__ffmpeg": VIDEO}, "/cam/image_raw/ffmpeg", False),
    ],
)
def test_raw_pictures_come_before_compressed_and_video_and_unrectified_before_rectified(images, chosen, rectified):
    (camera,) = discover_cameras(topics("/cam", **images))
    assert (camera.image_topic, camera.rectified) == (chosen, rectified)


def test_depth_images_and_cameras_without_images_are_no_cameras():
    found = topics("/cam/depth", image_rect=RAW) | topics("/silent") | topics("/cam", image_raw=RAW)
    assert [camera.name for camera in discover_cameras(found)] == ["cam"]


def test_what_a_node_puts_out_is_no_camera_beside_the_cameras():
    outputs = topics("/surround_depth/cam", image_rect=RAW) | topics("/surround_depth/cam/depth", image_rect=RAW)
    assert discover_cameras(outputs) == []
    cameras = topics("/cam", image_raw=RAW) | topics("/cam/depth", image_rect=RAW) | topics("/rect", image_rect=RAW)
    assert [camera.name for camera in discover_cameras(outputs | cameras)] == ["cam", "rect"]


def test_no_topics_are_no_cameras():
    assert discover_cameras({}) == []
