# SPDX-License-Identifier: Apache-2.0
"""Whatever a message of an accepted type says, it is used, or refused by an error that names where it came from."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cvcdepth_core.errors import CvcDepthError, ImageError, RecordingError, RigError
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_ros.bags import typestore
from cvcdepth_ros.messages.conversion import calibration_from_message, picture_from_message, stamp_ns
from cvcdepth_ros.messages.point_clouds import points_from_message
from cvcdepth_ros.messages.transforms import PoseTrack, TransformTree

TYPES = typestore().types
UINT32 = st.one_of(st.integers(0, 64), st.integers(0, 2**32 - 1))
NUMBERS = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-310, 1e308, float("nan"), float("inf")]), st.floats())
NAMES = st.one_of(st.sampled_from(["", "/", "base_link", "a", "b", "c"]), st.text(max_size=300))
BYTES = st.binary(max_size=600).map(lambda content: np.frombuffer(content, np.uint8))
FORMATS = st.one_of(st.sampled_from(["jpeg", "png", "bayer_rggb8; png compressed"]), st.text(max_size=80))
ENCODINGS = st.one_of(
    st.sampled_from(["rgb8", "bgra8", "mono16", "bayer_gbrg16", "mono8", "8UC3"]), st.text(max_size=20)
)


def built(type_name: str, /, **fields: Any) -> st.SearchStrategy[Any]:
    return st.builds(TYPES[type_name], **fields)


HEADERS = built(
    "std_msgs/msg/Header",
    stamp=built("builtin_interfaces/msg/Time", sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1)),
    frame_id=NAMES,
)
IMAGES = built(
    "sensor_msgs/msg/Image",
    header=HEADERS,
    height=UINT32,
    width=UINT32,
    encoding=ENCODINGS,
    is_bigendian=st.integers(0, 255),
    step=UINT32,
    data=BYTES,
)
STARTS = st.sampled_from([b"", b"\xff\xd8\xff", b"\xff\xd8\xff\xc0\0\x11\x08", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"])
COMPRESSED = built(
    "sensor_msgs/msg/CompressedImage",
    header=HEADERS,
    format=FORMATS,
    data=st.builds(lambda start, rest: np.frombuffer(start + rest, np.uint8), STARTS, st.binary(max_size=300)),
)


def rows(count: int) -> st.SearchStrategy[Any]:
    return st.lists(NUMBERS, min_size=count, max_size=count).map(np.array)


PLAUSIBLE_K = st.just(np.array([20.0, 0, 8, 0, 20, 6, 0, 0, 1]))
INFOS = built(
    "sensor_msgs/msg/CameraInfo",
    header=HEADERS,
    height=UINT32,
    width=UINT32,
    distortion_model=st.one_of(
        st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant"]), st.text(max_size=20)
    ),
    d=st.lists(NUMBERS, max_size=15).map(np.array),
    k=st.one_of(PLAUSIBLE_K, rows(9)),
    r=st.one_of(st.just(np.eye(3).ravel()), rows(9)),
    p=st.one_of(st.just(np.zeros(12)), rows(12)),
    binning_x=UINT32,
    binning_y=UINT32,
    roi=built(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=UINT32,
        y_offset=UINT32,
        height=UINT32,
        width=UINT32,
        do_rectify=st.booleans(),
    ),
)
CLOUDS = built(
    "sensor_msgs/msg/PointCloud2",
    header=HEADERS,
    height=UINT32,
    width=UINT32,
    fields=st.lists(
        built(
            "sensor_msgs/msg/PointField",
            name=st.one_of(st.sampled_from("xyz"), st.text(max_size=5)),
            offset=UINT32,
            datatype=st.one_of(st.sampled_from([7, 8]), st.integers(0, 255)),
            count=UINT32,
        ),
        max_size=5,
    ),
    is_bigendian=st.booleans(),
    point_step=UINT32,
    row_step=UINT32,
    data=BYTES,
    is_dense=st.booleans(),
)
VECTORS = built("geometry_msgs/msg/Vector3", x=NUMBERS, y=NUMBERS, z=NUMBERS)
UNIT = st.just(TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
QUATERNIONS = st.one_of(UNIT, built("geometry_msgs/msg/Quaternion", x=NUMBERS, y=NUMBERS, z=NUMBERS, w=NUMBERS))
LINKS = built(
    "geometry_msgs/msg/TransformStamped",
    header=HEADERS,
    child_frame_id=NAMES,
    transform=built("geometry_msgs/msg/Transform", translation=VECTORS, rotation=QUATERNIONS),
)
TRANSFORMS = built("tf2_msgs/msg/TFMessage", transforms=st.lists(LINKS, max_size=8))

HURRIED = settings(max_examples=80, deadline=None)


@HURRIED
@given(IMAGES)
def test_any_image_gives_a_picture_of_its_size_or_an_error_that_names_the_camera(message: Any):
    try:
        picture = picture_from_message(message, "rear")
    except ImageError as error:
        refusal = str(error)
    else:
        refusal = ""
        assert picture.shape == (message.height, message.width, 3)
    assert not refusal or "camera rear" in refusal
    assert len(refusal) < 600
    assert isinstance(stamp_ns(message), int)


@HURRIED
@given(COMPRESSED)
def test_any_compressed_image_gives_a_picture_or_an_error_that_names_the_camera(message: Any):
    with suppress(ImageError):
        assert picture_from_message(message, "rear").ndim == 3


@HURRIED
@given(INFOS)
def test_any_camera_info_gives_maps_or_an_error_that_names_the_camera(message: Any):
    try:
        calibration = calibration_from_message(message, "rear")
    except RigError as error:
        calibration, refusal = None, str(error)
    if calibration is None:
        assert "camera rear: camera_info" in refusal
    else:
        rectifier = Rectifier(calibration, 32, 64)
        assert np.isfinite(rectifier.intrinsics).all()
        assert rectifier.visible.shape == (32, 64)


@HURRIED
@given(CLOUDS)
def test_any_cloud_gives_finite_points_or_an_error_that_names_the_topic(message: Any):
    try:
        points = points_from_message(message, "/lidar")
    except RecordingError as error:
        points, refusal = np.empty((0, 3)), str(error)
    else:
        refusal = "/lidar"
    assert refusal.startswith("/lidar")
    assert np.isfinite(points).all()


@HURRIED
@given(st.lists(TRANSFORMS, max_size=4))
def test_any_transforms_leave_a_tree_without_loops(messages: list[Any]):
    tree = TransformTree()
    for message in messages:
        with suppress(CvcDepthError):
            tree.add_message(message)
    for frame in tree.frames:
        with suppress(CvcDepthError):
            assert np.isfinite(tree.lookup("base_link", frame)).all()


@HURRIED
@given(st.lists(TRANSFORMS, max_size=4), st.integers(-(2**62), 2**62))
def test_any_moving_transforms_leave_a_track_that_interpolates_to_rigid_poses(messages: list[Any], stamp: int):
    track = PoseTrack("base_link", "a")
    for message in messages:
        with suppress(CvcDepthError):
            track.add_message(message)
    with suppress(CvcDepthError):
        rotation = track.lookup(stamp)[:3, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-6)
