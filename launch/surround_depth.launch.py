# SPDX-License-Identifier: Apache-2.0
"""Start surround_depth_node: `ros2 launch cvcdepth_ros surround_depth.launch.py rig:=rig.yaml checkpoint:=w.safetensors`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

_DEFAULT_PARAMETERS = Path(get_package_share_directory("cvcdepth_ros")) / "config" / "surround_depth.yaml"


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node with them; arguments have precedence over the parameter file."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("rig", default_value="auto", description="Rig file (YAML), or auto."),
            DeclareLaunchArgument("checkpoint", default_value="", description="Checkpoint file (safetensors)."),
            DeclareLaunchArgument("params_file", default_value=str(_DEFAULT_PARAMETERS), description="Parameters."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Take the time from /clock."),
            Node(
                package="cvcdepth_ros",
                executable="surround_depth_node",
                name="surround_depth",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "rig": ParameterValue(LaunchConfiguration("rig"), value_type=str),
                        "checkpoint": ParameterValue(LaunchConfiguration("checkpoint"), value_type=str),
                        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
                    },
                ],
            ),
        ]
    )
