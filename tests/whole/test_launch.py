# SPDX-License-Identifier: Apache-2.0
"""The launch file. ROS 2's launch packages are not on PyPI: where they are missing, small stand-ins take their place.

The stand-ins record what the file declares; that `ros2 launch` accepts it is only seen where ROS 2 is installed.
"""

import importlib.util
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from repository import ROOT

LAUNCH_FILE = ROOT / "launch" / "surround_depth.launch.py"


class Recorded:
    """Stands for any class of launch: remembers what it was made with."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments, self.options = arguments, options

    def perform(self, context: dict[str, str]) -> str:
        return context[self.arguments[0]]


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], Any]:
    names = {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction"),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
        "launch_ros.parameter_descriptions": ("ParameterValue",),
        "ament_index_python": (),
        "ament_index_python.packages": (),
    }
    for module_name, classes in names.items():
        module = types.ModuleType(module_name)
        for name in classes:
            setattr(module, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module_name, module)
    packages: Any = sys.modules["ament_index_python.packages"]
    packages.get_package_share_directory = lambda package: str(tmp_path / package)
    spec = importlib.util.spec_from_file_location("surround_depth_launch", LAUNCH_FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description


def start(generate: Callable[[], Any], **given: str) -> Any:
    """The node that the launch file starts with these arguments."""
    entities = generate().arguments[0]
    declared = {
        e.arguments[0]: e.options["default_value"] for e in entities if type(e).__name__ == "DeclareLaunchArgument"
    }
    assert given.keys() <= declared.keys()
    function = next(e.options["function"] for e in entities if type(e).__name__ == "OpaqueFunction")
    (node,) = function(declared | given)
    return node


def test_arguments_left_empty_are_left_to_the_parameter_file(generate):
    node = start(generate)
    assert (node.options["package"], node.options["executable"]) == ("cvcdepth_ros", "surround_depth_node")
    assert len(node.options["parameters"]) == 1


def test_rig_and_checkpoint_have_precedence_over_the_parameter_file(generate):
    node = start(generate, rig="/data/rig.yaml", checkpoint="007")
    given = node.options["parameters"][1]
    assert given["rig"].arguments == ("/data/rig.yaml",)
    # A file name that looks like a number stays a string.
    assert given["checkpoint"].options == {"value_type": str}
    assert "use_sim_time" not in given


def test_frame_and_cameras_are_parameters_of_their_types(generate):
    (_, given) = start(generate, base_frame="007", min_cameras="4").options["parameters"]
    assert (given["base_frame"].arguments, given["base_frame"].options) == (("007",), {"value_type": str})
    (substitution,) = given["min_cameras"].arguments
    assert substitution.perform({"min_cameras": "4"}) == "4"
    assert given["min_cameras"].options == {"value_type": int}


def test_log_level_and_remappings_are_the_nodes(generate):
    node = start(generate, log_level="debug", remap="/camera/front/image:=/front/image  camera_info:=info")
    assert node.options["ros_arguments"] == ["--log-level", "debug"]
    assert node.options["remappings"] == [("/camera/front/image", "/front/image"), ("camera_info", "info")]
    assert start(generate).options["remappings"] == start(generate).options["ros_arguments"] == []


def test_a_remapping_that_is_none_is_named(generate):
    with pytest.raises(ValueError, match="expected FROM:=TO, found '/camera/front'"):
        start(generate, remap="a:=b /camera/front")


def test_simulated_time_is_asked_for_as_a_boolean(generate):
    (_, given) = start(generate, use_sim_time="true").options["parameters"]
    assert given["use_sim_time"].options == {"value_type": bool}


def test_an_argument_that_is_a_parameter_is_one_of_the_nodes_and_has_its_default_in_the_file(generate):
    stated = yaml.safe_load((ROOT / "config" / "surround_depth.yaml").read_text())["/**"]["ros__parameters"]
    (_, given) = start(generate, rig="a", checkpoint="b", base_frame="c", min_cameras="1", use_sim_time="true").options[
        "parameters"
    ]
    assert given.keys() - {"use_sim_time"} <= stated.keys()


def test_every_argument_says_what_it_is_for(generate):
    declared = [e for e in generate().arguments[0] if type(e).__name__ == "DeclareLaunchArgument"]
    names = {"rig", "checkpoint", "params_file", "namespace", "use_sim_time", "base_frame", "min_cameras"}
    assert {e.arguments[0] for e in declared} == names | {"log_level", "remap"}
    assert all(e.options["description"] for e in declared)
