# SPDX-License-Identifier: Apache-2.0
"""Our messages through Nav2's voxel marking and ray clearing and depth_image_proc's back-projection, written anew.

The costmap knows nothing of our code: it has the parameters of config/consumers, and the messages.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from repository import ROOT
from street_scene import POST, RIG, WALL, seen

from cvcdepth_ros.messages.conversion import bag_message_factory
from cvcdepth_ros.surround_sets.output_messages import OutputLimits, SurroundMessages
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

TOPICS = ("obstacles", "ground", "points", "scan", "left/depth/image_rect", "left/depth/camera_info", "left/points")
CAMERA_HEIGHT = 1.5
FREE, TAKEN, UNKNOWN = 0, 254, 255


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


class VoxelCostmap:
    """Columns of voxels around the vehicle: points mark theirs, rays to points clear those on the way."""

    def __init__(self, layer: dict[str, Any], size: float, resolution: float) -> None:
        self._layer, self._resolution, self._half = layer, resolution, size / 2
        cells = round(size / resolution)
        self._marked = np.zeros((cells, cells, layer["z_voxels"]), bool)
        self._known = np.zeros((cells, cells, layer["z_voxels"]), bool)

    def update(self, clouds: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]) -> None:
        """Clear with all sources that do, then mark: `clouds` has, by source, points and where their rays begin."""
        taken = {source: self._between(source, points) for source, (points, _) in clouds.items()}
        for source, (_, origin) in clouds.items():
            if self._layer[source]["clearing"]:
                self._clear(origin, taken[source], self._layer[source]["raytrace_max_range"])
        for source, (_, origin) in clouds.items():
            if self._layer[source]["marking"]:
                near = np.linalg.norm(taken[source] - origin, axis=1) <= self._layer[source]["obstacle_max_range"]
                self._set(self._cells(taken[source][near]), marked=True)

    def cost(self, x: float, y: float) -> int:
        column = tuple(self._cells(np.array([[x, y, 0.0]]))[0, :2].tolist())
        if self._marked[column].sum() > self._layer["mark_threshold"]:
            return TAKEN
        return FREE if self._known[column].any() else UNKNOWN

    def _between(self, source: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = (self._layer[source][f"{end}_obstacle_height"] for end in ("min", "max"))
        return points[(points[:, 2] >= low) & (points[:, 2] <= high)]

    def _clear(self, origin: NDArray[np.float64], points: NDArray[np.float64], reach: float) -> None:
        """Clear what the rays cross before their ends, in steps of half a cell."""
        offsets, ends = points - origin, self._cells(points)
        lengths = np.linalg.norm(offsets, axis=1)
        for way in np.arange(0.0, reach, 0.5 * self._resolution):
            on_way = way < lengths
            cells = self._cells(origin + offsets[on_way] * (way / lengths[on_way])[:, None])
            self._set(cells[(cells != ends[on_way]).any(axis=1)], marked=False)

    def _set(self, cells: NDArray[np.int64], marked: bool) -> None:
        inside = ((cells >= 0) & (cells < self._marked.shape)).all(axis=1)
        places = tuple(cells[inside].T)
        self._marked[places], self._known[places] = marked, True

    def _cells(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        flat = (points[:, :2] + self._half) / self._resolution
        high = (points[:, 2:] - self._layer["origin_z"]) / self._layer["z_resolution"]
        return np.floor(np.concatenate([flat, high], axis=1)).astype(np.int64)


@pytest.fixture
def costmap() -> VoxelCostmap:
    content = yaml.safe_load((ROOT / "config" / "consumers" / "nav2_costmap.yaml").read_text(encoding="utf-8"))
    parameters = content["local_costmap"]["local_costmap"]["ros__parameters"]
    layer = parameters["voxel_layer"]
    assert layer["observation_sources"].split() == ["obstacles", "points"]
    return VoxelCostmap(layer, parameters["width"], parameters["resolution"])


def clouds(found: dict[str, Any]) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """The sources of the layer: obstacles from the cloud's own frame, all points from the camera that is named."""
    camera = np.array([0.0, 0.0, CAMERA_HEIGHT])
    return {"obstacles": (points_of(found["obstacles"]), np.zeros(3)), "points": (points_of(found["points"]), camera)}


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
