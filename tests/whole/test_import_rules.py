# SPDX-License-Identifier: Apache-2.0
"""The arrows between the rooms: core knows neither ROS nor cvcdepth_ros; what is testable without ROS imports none."""

import ast
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from repository import ROOT

ROS = re.compile(
    r"rclpy|rosbag2_py|message_filters|cv_bridge|launch(_ros)?|(ament|rosidl|tf2)_\w+|\w+_(msgs|srvs|interfaces|msgs_py)"
)
CORE = sorted((ROOT / "cvcdepth_core").rglob("*.py"))
# The node's room, its program and the three programs that talk to it. All else must work where there is no ROS.
NEEDS_ROS = {
    *(path for path in (ROOT / "cvcdepth_ros" / "node").glob("*.py") if path.name != "__init__.py"),
    *(
        ROOT / "cvcdepth_ros" / f"{name}.py"
        for name in ("surround_depth_node", "bench/baseline_node", "commands/play", "end_to_end/recorder")
    ),
}
WITHOUT_ROS = [*CORE, *(path for path in sorted((ROOT / "cvcdepth_ros").rglob("*.py")) if path not in NEEDS_ROS)]
IMPORT_ALL_BUT_ROS = f"""
import importlib, re, sys

class RefuseRos:
    def find_spec(self, name, path=None, target=None):
        if re.fullmatch({ROS.pattern!r}, name.partition(".")[0]):
            raise RuntimeError(f"{{name}} was imported")

sys.meta_path.insert(0, RefuseRos())
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def imported_packages(source: Path) -> set[str]:
    """Name the top-level packages that the file imports anywhere, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def module_name(source: Path) -> str:
    return ".".join(source.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@pytest.mark.parametrize("source", WITHOUT_ROS, ids=module_name)
def test_a_module_that_must_work_without_ros_names_no_ros_package(source: Path):
    assert not {name for name in imported_packages(source) if ROS.fullmatch(name)}


@pytest.mark.parametrize("source", CORE, ids=module_name)
def test_core_does_not_know_the_ros_package(source: Path):
    assert "cvcdepth_ros" not in imported_packages(source)


def test_importing_them_all_imports_no_ros_package_through_another_module():
    names = [module_name(source) for source in WITHOUT_ROS]
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL_BUT_ROS, *names], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_package_xml_declares_every_ros_package_that_is_imported():
    sources = [path for folder in ("cvcdepth_ros", "launch") for path in (ROOT / folder).rglob("*.py")]
    imported = {name for source in sources for name in imported_packages(source) if ROS.fullmatch(name)}
    declared = {element.text for element in ElementTree.parse(ROOT / "package.xml").findall("exec_depend")}
    assert imported <= declared


@pytest.mark.parametrize("source", sorted(NEEDS_ROS), ids=module_name)
def test_a_module_on_the_list_of_those_that_need_ros_does(source: Path):
    assert any(ROS.fullmatch(name) for name in imported_packages(source))
