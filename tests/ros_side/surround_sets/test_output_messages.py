# SPDX-License-Identifier: Apache-2.0
"""Clouds, obstacles and scan of a set as messages, read as any consumer would."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from street_scene import RIG, seen

from cvcdepth_core.obstacles.separation import ObstacleLimits
from cvcdepth_core.pointcloud import CloudLimits
from cvcdepth_ros.messages.conversion import bag_message_factory
from cvcdepth_ros.settings import OutputSettings
from cvcdepth_ros.surround_sets import output_messages
from cvcdepth_ros.surround_sets.output_messages import OutputLimits, SurroundMessages, camera_topics, output_types
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

STAMP = 5 * 10**9 + 7
MERGED = ("points", "obstacles", "ground", "scan")


@pytest.fixture(scope="module")
def estimated() -> EstimatedSet:
    """The street with a post, the upper rows sky."""
    surround = seen().surround
    sky = np.zeros(surround.depth.shape, bool)
    sky[:, :20] = True
    stamps = dict.fromkeys(RIG.names, STAMP)
    surround_set: SurroundSet[None] = SurroundSet(
        sequence=0,
        anchor="left",
        images=dict.fromkeys(RIG.names),
        stamp_ns=STAMP,
        stamps_ns=stamps,
        times_ns=stamps,
        spread_ns=0,
    )
    return EstimatedSet(surround_set, RIG, replace(surround, sky=sky))


def built(estimated: EstimatedSet, *topics: str, limits: OutputLimits | None = None, **options: Any):
    messages = SurroundMessages(bag_message_factory(), options.pop("encoding", "32FC1"), **options)
    frames = {name: f"{name}_optical" for name in RIG.names}
    found = messages.of_set(estimated, frames, limits or OutputLimits(), topics.__contains__)
    return {one.topic: one.message for one in found}


def points(cloud) -> np.ndarray:
    assert [(field.name, field.offset, field.datatype) for field in cloud.fields][:3] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
    ]
    return cloud.data.view(np.float32).reshape(-1, cloud.point_step // 4)


def test_ground_and_obstacles_are_parts_of_the_cloud_in_the_base_frame(estimated):
    found = built(estimated, *MERGED)
    assert {message.header.frame_id for message in found.values()} == {"base_link"}
    assert {message.header.stamp.nanosec for message in found.values()} == {7}
    whole, obstacles, ground = (points(found[name]) for name in ("points", "obstacles", "ground"))
    rows = {row.tobytes() for row in whole}
    assert {row.tobytes() for row in obstacles} | {row.tobytes() for row in ground} <= rows
    assert np.abs(ground[:, 2]).max() < 0.3
    assert obstacles[:, 2].min() > 0.25
    assert obstacles[:, 2].max() < 2.05


def test_the_scan_tells_the_post_and_the_wall(estimated):
    scan = built(estimated, "scan")["scan"]
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    assert scan.angle_max == pytest.approx(angles[-1])
    assert len(scan.ranges) == 720
    ahead = np.abs(angles) < math.radians(2)
    np.testing.assert_allclose(scan.ranges[ahead], 6.0, atol=0.1)
    beside = np.abs(angles - math.radians(20)) < math.radians(2)
    np.testing.assert_allclose(scan.ranges[beside] * np.cos(angles[beside]), 12.0, atol=0.2)
    assert np.isnan(scan.ranges[np.abs(angles) > math.radians(60)]).all()  # no camera looks there
    known = scan.ranges[np.isfinite(scan.ranges)]
    assert ((known >= scan.range_min) & (known <= scan.range_max)).all()


@pytest.mark.parametrize(("sky", "expected"), [("far", np.inf), ("nan", np.nan)])
def test_the_sky_is_inf_or_nan_in_metres(estimated, sky, expected):
    image = built(estimated, "left/depth/image_rect", sky=sky)["left/depth/image_rect"]
    depth = image.data.view(np.float32).reshape(image.height, image.width)
    np.testing.assert_array_equal(depth[:20], np.full_like(depth[:20], expected))
    assert np.isfinite(depth[20:]).all()


def test_the_sky_is_0_in_millimetres(estimated):
    image = built(estimated, "left/depth/image_rect", sky="far", encoding="16UC1")["left/depth/image_rect"]
    millimetres = image.data.view(np.uint16).reshape(image.height, image.width)
    assert not millimetres[:20].any()
    assert millimetres[20:].all()


@pytest.mark.parametrize("sky", ["far", "nan", "keep"])
def test_no_cloud_has_points_of_the_sky(estimated, sky):
    found = built(estimated, "points", "left/points", sky=sky)
    organised = points(found["left/points"]).reshape(*estimated.result.depth.shape[1:], -1)
    assert np.isnan(organised[:20, :, 0]).all()
    assert np.isfinite(organised[20:, :, 0]).all()
    assert len(points(found["points"])) == np.count_nonzero(~estimated.result.sky)


def test_heights_limit_the_merged_cloud_and_not_what_is_made_of_it(estimated):
    limits = OutputLimits(cloud=CloudLimits(min_height=0.5, max_height=1.0), obstacles=ObstacleLimits(max_range=40.0))
    banded, plain = built(estimated, *MERGED, limits=limits), built(estimated, *MERGED)
    heights = points(banded["points"])[:, 2]
    assert 0 < len(heights) < len(points(plain["points"]))
    assert ((heights >= 0.5) & (heights <= 1.0)).all()
    np.testing.assert_array_equal(banded["obstacles"].data, plain["obstacles"].data)
    np.testing.assert_array_equal(banded["scan"].ranges, plain["scan"].ranges)


def test_nothing_is_computed_that_nobody_asks_for_and_nothing_twice(estimated, monkeypatch):
    calls = []
    for name in ("merged_cloud", "separate", "scan_of"):
        real = getattr(output_messages, name)
        monkeypatch.setattr(output_messages, name, lambda *a, n=name, r=real: (calls.append(n), r(*a))[1])
    built(estimated, "left/depth/image_rect", "points/cameras")
    assert calls == []
    built(estimated, "points")
    assert calls == ["merged_cloud"]
    calls.clear()
    built(estimated, *MERGED)
    assert calls == ["merged_cloud", "separate", "scan_of"]


def test_every_camera_is_needed_for_what_is_made_of_all():
    assert set(MERGED) <= set(camera_topics("left")) & set(output_types(["left"]))
    assert output_types(["left"])["scan"] == "sensor_msgs/msg/LaserScan"


def test_the_settings_limits_are_the_outputs_limits():
    settings = OutputSettings.model_validate(
        {"obstacle_max_height": 1.5, "scan_resolution": 1.0, "cloud_min_height": -2}
    )
    limits = OutputLimits.of(settings)
    assert (limits.obstacles.max_height, limits.scan.beams, limits.cloud.min_height) == (1.5, 360, -2)


@pytest.mark.parametrize("kind", ["cloud", "obstacle"])
def test_a_band_of_heights_that_is_empty_is_refused_by_name(kind):
    with pytest.raises(ValueError, match=f"{kind}_min_height 3 must be below {kind}_max_height 2"):
        OutputSettings.model_validate({f"{kind}_min_height": 3.0, f"{kind}_max_height": 2.0})


def test_clouds_are_moved_to_the_anchors_moment_where_motion_is_known_and_it_is_told(estimated):
    later = np.eye(4)
    later[0, 3] = 2.0
    moving = replace(estimated, world_T_base=np.stack([np.eye(4), later]))
    wanted, frames = "points".__eq__, dict.fromkeys(RIG.names, "optical")
    builder = SurroundMessages(bag_message_factory(), "32FC1")

    def cloud(one: EstimatedSet, deskew: bool) -> np.ndarray:
        (found,) = builder.of_set(one, frames, OutputLimits(deskew=deskew), wanted)
        return points(found.message)

    standing = cloud(estimated, False)
    np.testing.assert_array_equal(cloud(moving, False), standing)
    assert builder.deskewed is False
    np.testing.assert_array_equal(cloud(estimated, True), standing)  # nobody knows how the vehicle moved
    assert builder.deskewed is False
    moved = cloud(moving, True)
    assert builder.deskewed is True
    shift = (moved - standing)[:, 0]
    np.testing.assert_allclose(np.unique(np.round(shift, 3)), [0.0, 2.0])


def test_the_field_t_tells_each_points_exposure(estimated):
    surround_set = replace(estimated.surround_set, times_ns={"left": STAMP, "right": STAMP + 81_000_000})
    found = built(
        replace(estimated, surround_set=surround_set),
        *("points", "obstacles", "left/points"),
        limits=OutputLimits(has_times=True),
    )
    for topic in ("points", "obstacles"):
        assert [field.name for field in found[topic].fields] == ["x", "y", "z", "rgb", "t"]
        assert found[topic].point_step == 20
        assert len(found[topic].data) == 20 * found[topic].width
        np.testing.assert_array_equal(np.unique(points(found[topic])[:, 4]), np.float32([0, 0.081]))
    assert len(found["left/points"].fields) == 4


def test_points_that_the_set_before_did_not_show_are_left_out_where_that_is_asked_for(estimated):
    builder, frames = SurroundMessages(bag_message_factory(), "32FC1"), dict.fromkeys(RIG.names, "optical")
    places = np.stack([np.eye(4)] * 2)

    def count(surround: Any, time: int) -> int:
        surround_set = replace(estimated.surround_set, times_ns=dict.fromkeys(RIG.names, time))
        one = replace(estimated, surround_set=surround_set, result=surround, world_T_base=places)
        (found,) = builder.of_set(one, frames, OutputLimits(persistence=1), "points".__eq__)
        return int(found.message.width)

    street, empty = estimated.result, replace(seen(post=False).surround, sky=estimated.result.sky)
    assert count(empty, STAMP) == np.count_nonzero(~empty.sky)
    assert count(street, STAMP + 10**8) < np.count_nonzero(~street.sky) - 100  # the post is new
    assert count(street, STAMP + 2 * 10**8) == np.count_nonzero(~street.sky)
