# SPDX-License-Identifier: Apache-2.0
"""Our messages through Nav2's voxel marking and ray clearing and depth_image_proc's back-projection, written anew.

The costmap is that of tools/costmap_trial.py: it knows points and the parameters of config/consumers, none of our code.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from repository import load_tool
from street_scene import POST, RIG, WALL, seen

from cvcdepth_ros.messages.conversion import bag_message_factory
from cvcdepth_ros.surround_sets.output_messages import OutputLimits, SurroundMessages
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

TOPICS = ("obstacles", "ground", "points", "scan", "left/depth/image_rect", "left/depth/camera_info", "left/points")
CAMERA_HEIGHT = 1.5
tool = load_tool("costmap_trial")
FREE, TAKEN, UNKNOWN = tool.FREE, tool.TAKEN, tool.UNKNOWN


def messages(post: bool) -> dict[str, Any]:
    """What the node would publish of the street with or without its post, the upper quarter of the pictures sky."""
    surround = seen(post=post).surround
    sky = np.zeros(surround.depth.shape, bool)
    sky[:, :24] = True
    stamps = dict.fromkeys(RIG.names, 10**9)
    surround_set: SurroundSet[None] = SurroundSet(0, "left", 10**9, stamps, stamps, dict.fromkeys(RIG.names), 0)
    estimated = EstimatedSet(surround_set, RIG, replace(surround, sky=sky))
    builder = SurroundMessages(bag_message_factory(), "32FC1", sky="far")
    found = builder.of_set(estimated, dict.fromkeys(RIG.names, "optical"), OutputLimits(), TOPICS.__contains__)
    return {one.topic: one.message for one in found}


@pytest.fixture(scope="module")
def with_post() -> dict[str, Any]:
    return messages(post=True)


@pytest.fixture(scope="module")
def without_post() -> dict[str, Any]:
    return messages(post=False)


def points_of(cloud: Any) -> NDArray[np.float64]:
    """x, y, z of a PointCloud2, by the names and offsets of its fields."""
    rows = np.frombuffer(cloud.data.tobytes(), np.uint8).reshape(-1, cloud.point_step)
    offsets = {field.name: field.offset for field in cloud.fields}
    return np.stack([rows[:, offsets[a] : offsets[a] + 4].copy().view("<f4")[:, 0] for a in "xyz"], 1).astype(float)


@pytest.fixture
def costmap() -> Any:
    assert tool.VoxelCostmap.from_file()._layer["observation_sources"].split() == ["obstacles", "points"]
    return tool.VoxelCostmap.from_file()


def clouds(found: dict[str, Any]) -> dict[str, Any]:
    """The sources of the layer: obstacles from the cloud's own frame, all points from the camera that is named."""
    camera = np.array([0.0, 0.0, CAMERA_HEIGHT])
    return {
        "obstacles": tool.Observation(points_of(found["obstacles"]), np.zeros(3)),
        "points": tool.Observation(points_of(found["points"]), camera),
    }


def along(x: float, *ys: float) -> Iterator[tuple[float, float]]:
    return ((x, y) for y in ys)


def test_the_costmap_has_the_post_and_the_wall_and_the_road_is_free(costmap, with_post):
    costmap.update(clouds(with_post))
    x, left, right = POST
    assert [costmap.cost(*at) for at in along(x + 0.1, left + 0.2, 0.0, right - 0.2)] == [TAKEN] * 3
    assert [costmap.cost(*at) for at in along(WALL + 0.1, -3.0, 3.0)] == [TAKEN] * 2
    assert [costmap.cost(*at) for at in along(4.0, -0.5, 0.0, 0.5)] == [FREE] * 3
    assert [costmap.cost(*at) for at in along(9.0, -3.0, 3.0)] == [FREE] * 2
    assert costmap.cost(WALL - 3, 0.0) != TAKEN  # behind the post
    assert costmap.cost(-5.0, 0.0) == UNKNOWN  # no camera looks back


def test_when_the_post_is_gone_the_rays_past_it_clear_its_place(costmap, with_post, without_post):
    costmap.update(clouds(with_post))
    assert costmap.cost(POST[0] + 0.1, 0.0) == TAKEN
    costmap.update(clouds(without_post))
    assert costmap.cost(POST[0] + 0.1, 0.0) == FREE
    assert costmap.cost(WALL + 0.1, 0.0) == TAKEN


def test_depth_images_back_projected_by_their_camera_info_are_the_organised_cloud(with_post):
    image, info = with_post["left/depth/image_rect"], with_post["left/depth/camera_info"]
    assert (image.header.stamp, image.header.frame_id) == (info.header.stamp, info.header.frame_id)
    assert (image.height, image.width) == (info.height, info.width)
    depth = image.data.view(np.float32).reshape(image.height, image.width)
    fx, fy, cx, cy = info.p[0], info.p[5], info.p[2], info.p[6]
    v, u = np.mgrid[: image.height, : image.width]
    is_valid = np.isfinite(depth)
    z = np.where(is_valid, depth, np.nan)
    expected = np.stack([(u - cx) * z / fx, (v - cy) * z / fy, z], axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(points_of(with_post["left/points"]), expected, rtol=1e-5, atol=1e-4)
    assert 0.7 < is_valid.mean() < 0.8
    assert np.isposinf(depth[~is_valid]).all()


def test_clouds_for_consumers_have_finite_points_only(with_post):
    for topic in ("obstacles", "ground", "points"):
        assert with_post[topic].is_dense
        assert np.isfinite(points_of(with_post[topic])).all()
