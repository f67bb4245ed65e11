# SPDX-License-Identifier: Apache-2.0
"""`surround_depth_node`: a managed node that turns synchronised camera images into depth images and point clouds."""

import argparse
import os
import sys
from collections.abc import Sequence

from cvcdepth_ros.process_setup import openmp_environment, prepare_process
from cvcdepth_ros.settings import NodeParameters

_HELP = """example:
  surround_depth_node --ros-args -p rig:=rig.yaml -p checkpoint:=model.safetensors
  surround_depth_node --ros-args --params-file config/surround_depth.yaml

parameters (all are described by `ros2 param describe /surround_depth NAME`):
"""

_WITHOUT_ROS = (
    "surround_depth_node: needs ROS 2, but {reason}: source a ROS 2 installation, or install this package with its "
    "extra ros-jazzy"
)


def main(args: Sequence[str] | None = None) -> None:
    """Run the node until it is interrupted or terminated."""
    arguments = list(sys.argv if args is None else args)
    os.environ.update(openmp_environment())  # before rclpy and what follows load torch
    prepare_process()
    try:
        from rclpy.utilities import remove_ros_args

        from cvcdepth_ros.node.surround_node import run
    except ImportError as error:
        if {"-h", "--help"} & set(arguments[1:]):
            _parse_command_line(["--help"])
        sys.exit(_WITHOUT_ROS.format(reason=error))
    try:
        own = remove_ros_args(arguments)[1:]
    except Exception as error:  # rclpy raises many kinds
        sys.exit(f"surround_depth_node: {str(error).splitlines()[0]}")
    _parse_command_line(own)
    run(arguments)


def _parse_command_line(arguments: Sequence[str]) -> None:
    parameters = "".join(
        f"  {name:16} {field.description} [{field.default}]\n" for name, field in NodeParameters.model_fields.items()
    )
    parser = argparse.ArgumentParser(
        prog="surround_depth_node",
        description=__doc__,
        epilog=_HELP + parameters,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(arguments)


if __name__ == "__main__":
    main()
