# SPDX-License-Identifier: Apache-2.0
"""Start the node: `ros2 launch cvcdepth_ros surround_depth.launch.py rig:=rig.yaml checkpoint:=model.safetensors`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; those left empty are left to the parameter file."""
    parameters = Path(get_package_share_directory("cvcdepth_ros")) / "config" / "surround_depth.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("rig", default_value="", description="Rig file (YAML), or auto."),
            DeclareLaunchArgument("checkpoint", default_value="", description="Checkpoint file (safetensors)."),
            DeclareLaunchArgument("params_file", default_value=str(parameters), description="Parameter file (YAML)."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument("use_sim_time", default_value="", description="Take the time from /clock."),
            OpaqueFunction(function=_start_node),
        ]
    )


def _start_node(context: LaunchContext) -> list[Node]:
    files = {name: LaunchConfiguration(name).perform(context) for name in ("rig", "checkpoint")}
    # As strings: a file name that looks like a number or a list must stay a file name.
    given = {name: ParameterValue(value, value_type=str) for name, value in files.items() if value}
    if LaunchConfiguration("use_sim_time").perform(context):
        given["use_sim_time"] = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    return [
        Node(
            package="cvcdepth_ros",
            executable="surround_depth_node",
            name="surround_depth",
            namespace=LaunchConfiguration("namespace"),
            output="screen",
            parameters=[LaunchConfiguration("params_file"), *([given] if given else [])],
        )
    ]
