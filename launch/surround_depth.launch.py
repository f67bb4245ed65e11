# SPDX-License-Identifier: Apache-2.0
"""Start the node: `ros2 launch cvcdepth_ros surround_depth.launch.py rig:=rig.yaml checkpoint:=model.safetensors`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription

_TYPES = {"rig": str, "checkpoint": str, "base_frame": str, "min_cameras": int, "use_sim_time": bool}
"""The parameters that are arguments too; those left empty are left to the parameter file."""


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
            DeclareLaunchArgument("base_frame", default_value="", description="With rig auto: the vehicle's frame."),
            DeclareLaunchArgument("min_cameras", default_value="", description="Cameras that are enough for a set."),
            DeclareLaunchArgument("log_level", default_value="", description="debug, info, warn, error or fatal."),
            DeclareLaunchArgument(
                "remap", default_value="", description="Remappings, as in '/camera/front/image:=/front/image a:=b'."
            ),
            OpaqueFunction(function=_start_node),
        ]
    )


def _start_node(context: LaunchContext) -> list[Node]:
    values = {name: LaunchConfiguration(name).perform(context) for name in _TYPES}
    given = {name: _typed(name, value) for name, value in values.items() if value}
    level = LaunchConfiguration("log_level").perform(context)
    return [
        Node(
            package="cvcdepth_ros",
            executable="surround_depth_node",
            name="surround_depth",
            namespace=LaunchConfiguration("namespace"),
            output="screen",
            parameters=[LaunchConfiguration("params_file"), *([given] if given else [])],
            remappings=_remappings(LaunchConfiguration("remap").perform(context)),
            ros_arguments=["--log-level", level] if level else [],
        )
    ]


def _typed(name: str, value: str) -> ParameterValue:
    """Return a parameter of its type: a file name that looks like a number or a list must stay a file name."""
    # Text is no value of another type; launch converts a substitution.
    return ParameterValue(value if _TYPES[name] is str else LaunchConfiguration(name), value_type=_TYPES[name])


def _remappings(text: str) -> list[tuple[str, str]]:
    """Return the pairs of 'FROM:=TO FROM:=TO'; ValueError names the one that is none."""
    pairs = [word.partition(":=") for word in text.split()]
    for source, _, target in pairs:
        if not source or not target:
            raise ValueError(f"remap: expected FROM:=TO, found '{source or text}'")
    return [(source, target) for source, _, target in pairs]
