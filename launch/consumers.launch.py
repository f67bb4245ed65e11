# SPDX-License-Identifier: Apache-2.0
"""Start a consumer of our topics: `ros2 launch cvcdepth_ros consumers.launch.py consumer:=octomap_server`.

Its parameters are those of config/consumers; docs/consumers.md says which consumer takes what.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

_DEPTH, _DEPTH_INFO, _COLOUR, _COLOUR_INFO = "depth/image_rect", "depth/camera_info", "image_rect", "camera_info"
_MOST_CAMERAS = 4


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "consumer", default_value="octomap_server", description=f"One of {', '.join(_CONSUMERS)}."
            ),
            DeclareLaunchArgument("depth_node", default_value="/surround_depth", description="Our node's name."),
            DeclareLaunchArgument(
                "cameras",
                default_value="front front_left front_right back",
                description="nvblox, rtabmap: four at most.",
            ),
            DeclareLaunchArgument("params_file", default_value="", description="Its parameters, in place of ours."),
            OpaqueFunction(function=_start),
        ]
    )


def _start(context: LaunchContext) -> list[Node]:
    consumer, source, cameras, given = (
        LaunchConfiguration(name).perform(context) for name in ("consumer", "depth_node", "cameras", "params_file")
    )
    if consumer not in _CONSUMERS:
        raise ValueError(f"consumer: expected one of {', '.join(_CONSUMERS)}, found '{consumer}'")
    names = cameras.split()
    if not 0 < len(names) <= _MOST_CAMERAS:
        raise ValueError(f"cameras: expected one to {_MOST_CAMERAS} names, found '{cameras}'")
    shipped = Path(get_package_share_directory("cvcdepth_ros")) / "config" / "consumers" / f"{consumer}.yaml"
    nodes: list[Node] = _CONSUMERS[consumer](source, names, given or str(shipped))
    return nodes


def _octomap(source: str, _: list[str], parameters: str) -> list[Node]:
    remappings = [("cloud_in", f"{source}/points")]
    return [_node("octomap_server", "octomap_server_node", "octomap_server", [parameters], remappings)]


def _nvblox(source: str, cameras: list[str], parameters: str) -> list[Node]:
    remappings = []
    for number, name in enumerate(cameras):
        for kind, image, info in (("depth", _DEPTH, _DEPTH_INFO), ("color", _COLOUR, _COLOUR_INFO)):
            remappings += [
                (f"camera_{number}/{kind}/image", f"{source}/{name}/{image}"),
                (f"camera_{number}/{kind}/camera_info", f"{source}/{name}/{info}"),
            ]
    return [_node("nvblox_ros", "nvblox_node", "nvblox_node", [parameters, {"num_cameras": len(cameras)}], remappings)]


def _rtabmap(source: str, cameras: list[str], parameters: str) -> list[Node]:
    synchronised = [
        _node(
            "rtabmap_sync",
            "rgbd_sync",
            f"rgbd_sync{number}",
            [{"approx_sync": False}],  # each camera's depth has exactly its picture's stamp
            [
                ("rgb/image", f"{source}/{name}/{_COLOUR}"),
                ("rgb/camera_info", f"{source}/{name}/{_COLOUR_INFO}"),
                ("depth/image", f"{source}/{name}/{_DEPTH}"),
                ("rgbd_image", f"rgbd_image{number}"),
            ],
        )
        for number, name in enumerate(cameras)
    ]
    return [
        *synchronised,
        _node("rtabmap_slam", "rtabmap", "rtabmap", [parameters, {"rgbd_cameras": len(cameras)}], []),
    ]


def _collision_monitor(source: str, _: list[str], parameters: str) -> list[Node]:
    topic = {"obstacles.topic": f"{source}/obstacles"}
    return [_node("nav2_collision_monitor", "collision_monitor", "collision_monitor", [parameters, topic], [])]


def _elevation_mapping(source: str, _: list[str], parameters: str) -> list[Node]:
    topic = {"input_sources.cameras.topic": f"{source}/points"}
    return [_node("elevation_mapping", "elevation_mapping", "elevation_mapping", [parameters, topic], [])]


def _autoware(source: str, _: list[str], parameters: str) -> list[Node]:
    remappings = [
        ("~/input/obstacle_pointcloud", f"{source}/obstacles"),
        ("~/input/raw_pointcloud", f"{source}/points"),
        ("~/output/occupancy_grid_map", "/perception/occupancy_grid_map/map"),
    ]
    package, executable = "autoware_probabilistic_occupancy_grid_map", "pointcloud_based_occupancy_grid_map_node"
    return [_node(package, executable, "occupancy_grid_map_node", [parameters], remappings)]


def _node(
    package: str, executable: str, name: str, parameters: list[object], remappings: list[tuple[str, str]]
) -> Node:
    return Node(
        package=package,
        executable=executable,
        name=name,
        output="screen",
        parameters=parameters,
        remappings=remappings,
    )


_CONSUMERS = {
    "octomap_server": _octomap,
    "nvblox": _nvblox,
    "rtabmap": _rtabmap,
    "nav2_collision_monitor": _collision_monitor,
    "elevation_mapping": _elevation_mapping,
    "autoware_occupancy_grid": _autoware,
}
"""By the name of its file in config/consumers, what starts it."""
