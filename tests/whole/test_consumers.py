# SPDX-License-Identifier: Apache-2.0
"""Parameter files for consumers of our topics have parameters that these have, and topics that the node has.

The names were read in the consumers' public documents and sources on 1 December 2026.
"""

import importlib.util
import sys
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from repository import ROOT

from cvcdepth_ros.surround_sets.output_messages import output_types

FOLDER = ROOT / "config" / "consumers"
FILES = sorted(FOLDER.glob("*.yaml"))
PAGE = (ROOT / "docs" / "consumers.md").read_text(encoding="utf-8")

_COSTMAP = """global_frame robot_base_frame update_frequency publish_frequency rolling_window width height resolution
    plugins"""
_SOURCE = """topic data_type sensor_frame marking clearing inf_is_valid min_obstacle_height max_obstacle_height
    obstacle_min_range obstacle_max_range raytrace_min_range raytrace_max_range observation_persistence
    expected_update_rate"""
_LAYER = """plugin enabled footprint_clearing_enabled min_obstacle_height max_obstacle_height combination_method
    observation_sources"""
_VOXELS = "origin_z z_resolution z_voxels unknown_threshold mark_threshold publish_voxel_map"
_POLYGON = """type points radius action_type min_points slowdown_ratio linear_limit angular_limit time_before_collision
    simulation_time_step visualize polygon_pub_topic polygon_sub_topic footprint_topic enabled"""

KNOWN: dict[str, dict[str, str]] = {
    "nav2_costmap": {
        "": _COSTMAP,
        "voxel_layer": f"{_LAYER} {_VOXELS}",
        "voxel_layer.obstacles": _SOURCE,
        "voxel_layer.points": _SOURCE,
        "inflation_layer": "plugin enabled inflation_radius cost_scaling_factor inflate_unknown inflate_around_unknown",
    },
    "nav2_costmap_scan": {
        "": _COSTMAP,
        "obstacle_layer": _LAYER,
        "obstacle_layer.scan": _SOURCE,
        "inflation_layer": "plugin enabled inflation_radius cost_scaling_factor inflate_unknown inflate_around_unknown",
    },
    "nav2_collision_monitor": {
        "": """base_frame_id odom_frame_id cmd_vel_in_topic cmd_vel_out_topic state_topic transform_tolerance
            source_timeout base_shift_correction stop_pub_timeout polygons observation_sources""",
        "PolygonStop": _POLYGON,
        "PolygonSlow": _POLYGON,
        "obstacles": "type topic min_height max_height source_timeout enabled",
    },
    "octomap_server": {
        "": """frame_id base_frame_id resolution sensor_model.max_range sensor_model.hit sensor_model.miss
            sensor_model.min sensor_model.max point_cloud_min_z point_cloud_max_z occupancy_min_z occupancy_max_z
            filter_ground_plane filter_speckles incremental_2D_projection""",
    },
    "nvblox": {"": "global_frame num_cameras use_tf_transforms use_depth use_color use_lidar voxel_size"},
    "rtabmap": {
        "": """frame_id odom_frame_id map_frame_id subscribe_depth subscribe_rgb subscribe_rgbd rgbd_cameras approx_sync
            sync_queue_size wait_for_transform Rtabmap/DetectionRate Grid/Sensor Grid/RangeMax Grid/CellSize
            Grid/MaxObstacleHeight""",
    },
    "elevation_mapping": {
        "": """map_frame_id robot_base_frame_id robot_pose_cache_size track_point_frame_id track_point_x track_point_y
            track_point_z length_in_x length_in_y resolution min_update_rate fused_map_publishing_rate""",
        "input_sources": "",
        "input_sources.cameras": "type topic queue_size publish_on_update",
        "input_sources.cameras.sensor_processor": "type ignore_points_above ignore_points_below",
    },
    "autoware_occupancy_grid": {
        "": """map_frame base_link_frame scan_origin_frame gridmap_origin_frame map_length map_resolution
            use_height_filter enable_single_frame_mode filter_obstacle_pointcloud_by_raw_pointcloud
            downsample_input_pointcloud""",
    },
}


def parameters(path: Path) -> dict[str, Any]:
    """The parameters of the file's only node."""
    content: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
    while "ros__parameters" not in content:
        (content,) = content.values()
    found: dict[str, Any] = content["ros__parameters"]
    return found


def by_section(content: Mapping[str, Any], section: str = "") -> Iterator[tuple[str, str, Any]]:
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from by_section(value, f"{section}.{name}".lstrip("."))
        else:
            yield section, name, value


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_has_only_parameters_that_its_consumer_has(path: Path):
    known = {section: names.split() for section, names in KNOWN[path.stem].items()}
    assert [f"{s}.{n}" for s, n, _ in by_section(parameters(path)) if n not in known.get(s, ())] == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_names_only_topics_that_the_node_publishes_with_the_type_that_is_taken(path: Path):
    types_of = output_types([])
    for section, name, value in by_section(parameters(path)):
        if name == "topic":
            assert value.startswith("/surround_depth/"), section
            kind = "LaserScan" if "scan" in section else "PointCloud2"
            assert types_of[value.removeprefix("/surround_depth/")].endswith(kind)


def test_every_file_is_on_the_page_and_every_file_on_the_page_is_there():
    assert FILES
    assert {path.stem for path in FILES} == KNOWN.keys()
    assert [path.name for path in FILES if f"`config/consumers/{path.name}`" not in PAGE] == []


class Recorded:
    """Stands for any class of launch: remembers what it was made with."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments, self.options = arguments, options

    def perform(self, context: dict[str, str]) -> str:
        return context[self.arguments[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The launch file, loaded with stand-ins for ROS 2's launch packages, which are not on PyPI."""
    names = {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction"),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
        "ament_index_python": (),
        "ament_index_python.packages": (),
    }
    for module_name, classes in names.items():
        module = types.ModuleType(module_name)
        for name in classes:
            setattr(module, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module_name, module)
    packages: Any = sys.modules["ament_index_python.packages"]
    packages.get_package_share_directory = lambda package: str(ROOT)
    spec = importlib.util.spec_from_file_location("consumers_launch", ROOT / "launch" / "consumers.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(launch_file: Any, **given: str) -> list[Any]:
    entities = launch_file.generate_launch_description().arguments[0]
    declared = {
        e.arguments[0]: e.options.get("default_value", "")
        for e in entities
        if type(e).__name__ == "DeclareLaunchArgument"
    }
    assert given.keys() <= declared.keys()
    assert all(e.options["description"] for e in entities if type(e).__name__ == "DeclareLaunchArgument")
    function = next(e.options["function"] for e in entities if type(e).__name__ == "OpaqueFunction")
    nodes: list[Any] = function(declared | given)
    return nodes


@pytest.mark.parametrize("consumer", sorted(KNOWN.keys() - {"nav2_costmap", "nav2_costmap_scan"}))
def test_a_consumer_starts_with_its_file_and_takes_topics_that_the_node_publishes(launch_file, consumer):
    nodes = started(launch_file, consumer=consumer, depth_node="/cameras", cameras="front back")
    published = {f"/cameras/{topic}" for topic in output_types(["front", "back"])}
    *_, last = nodes
    assert last.options["parameters"][0] == str(FOLDER / f"{consumer}.yaml")
    taken = [target for node in nodes for _, target in node.options["remappings"] if target.startswith("/cameras")]
    for node in nodes:
        for values in node.options["parameters"]:
            if isinstance(values, Mapping):
                taken += [value for value in values.values() if isinstance(value, str)]
    assert taken
    assert set(taken) <= published


def test_four_cameras_are_the_most_and_an_unknown_consumer_is_named(launch_file):
    (nvblox,) = started(launch_file, consumer="nvblox", cameras="a b c d")
    assert len(nvblox.options["remappings"]) == 16
    with pytest.raises(ValueError, match="cameras: expected one to 4 names, found 'a b c d e'"):
        started(launch_file, consumer="nvblox", cameras="a b c d e")
    with pytest.raises(ValueError, match=r"consumer: expected one of .*, found 'mapper'"):
        started(launch_file, consumer="mapper")
