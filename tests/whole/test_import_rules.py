# SPDX-License-Identifier: Apache-2.0
"""The walls between the rooms: who may import whom, and where ROS may be imported; and that a broken wall is told."""

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from repository import ROOT, load_tool

rooms = load_tool("rooms")

IMPORT_ALL_BUT_ROS = f"""
import importlib, re, sys

class RefuseRos:
    def find_spec(self, name, path=None, target=None):
        if re.fullmatch({rooms.ROS.pattern!r}, name.partition(".")[0]):
            raise RuntimeError(f"{{name}} was imported")

sys.meta_path.insert(0, RefuseRos())
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


@pytest.fixture(scope="module")
def tree() -> Any:
    return rooms.Tree(ROOT)


def test_every_room_imports_only_what_the_list_allows_and_no_rooms_import_each_other(tree: Any):
    assert rooms.broken_walls(tree) == []


def test_ros_is_imported_by_the_node_and_the_named_programs_only_and_core_knows_no_format_of_it(tree: Any):
    assert rooms.misplaced_ros(tree) == []


def test_importing_all_other_modules_imports_no_ros_package_by_way_of_a_third(tree: Any):
    patterns = (*rooms.HOUSE.needs_ros, *rooms.HOUSE.needs_ros_late)
    names = [name for name in tree.modules if not any(rooms.fnmatchcase(name, pattern) for pattern in patterns)]
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL_BUT_ROS, *names], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_package_xml_declares_every_ros_package_that_is_imported():
    house = rooms.House({"cvcdepth_ros": {}, "launch": {}})
    imported = {entry.imported.partition(".")[0] for entry in rooms.Tree(ROOT, house).imports}
    declared = {element.text for element in ElementTree.parse(ROOT / "package.xml").findall("exec_depend")}
    assert {name for name in imported if rooms.ROS.fullmatch(name)} <= declared


@pytest.mark.parametrize(("folder", "package"), [("core", "cvcdepth_core"), ("ros_side", "cvcdepth_ros")])
def test_the_tests_folders_are_called_like_the_rooms(folder: str, package: str):
    folders = {path.name for path in (ROOT / "tests" / folder).iterdir() if path.is_dir() and path.name[0] != "_"}
    assert folders <= set(rooms.HOUSE.packages[package])


def test_the_architecture_page_has_the_table_made_from_the_imports(tree: Any):
    page = rooms.PAGE.read_text(encoding="utf-8")
    assert page == rooms.with_table(page, rooms.table(tree)), "python tools/rooms.py --write"


# ---- The rules themselves, on a small house that keeps them, and with one wall broken after the other.

SOUND = {
    "low/__init__.py": '"""All that is below."""',
    "low/ground.py": '"""What all stand on. And more."""',
    "low/cellar/__init__.py": "",
    "low/cellar/wine.py": "from low import ground",
    "low/attic/__init__.py": "",
    "low/attic/box.py": "from low.cellar import wine",
    "high/__init__.py": "",
    "high/quiet/__init__.py": "",
    "high/quiet/reader.py": "import rosbags\nfrom low.attic.box import thing",
    "high/noisy/__init__.py": "",
    "high/noisy/node.py": "import rclpy",
    "high/play.py": "def execute():\n    from high.noisy.node import Node",
}
LOW = {"ground": "", "cellar": "ground", "attic": "ground cellar"}
HIGH = {"quiet": "", "noisy": "quiet", "play": "noisy"}


def small(folder: Path, files: Mapping[str, str] = {}, low: Mapping[str, str] = LOW) -> Any:
    """The small house with some of its files changed."""
    for name, content in {**SOUND, **files}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return rooms.Tree(folder, rooms.House({"low": low, "high": HIGH}, ("high.noisy.*",), ("high.play",)))


def problems(tree: Any) -> list[str]:
    return [*rooms.broken_walls(tree), *rooms.misplaced_ros(tree)]


def test_a_house_that_keeps_its_rules_has_no_problem(tmp_path: Path):
    assert problems(small(tmp_path)) == []


@pytest.mark.parametrize(
    "statement",
    [
        "import low.attic.box",
        "from low.attic import box",
        "from low.attic.box import thing",
        "from ..attic import box",
        "from ..attic.box import thing",
        "def later():\n    from low.attic import box",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from low.attic.box import Box",
    ],
)
def test_an_upward_arrow_is_named_with_its_line_however_it_is_written(tmp_path: Path, statement: str):
    found = problems(small(tmp_path, {"low/cellar/wine.py": statement}))
    line = len(statement.splitlines())
    assert found[0].startswith(f"low/cellar/wine.py:{line}: low.cellar.wine imports low.attic")
    assert found[0].endswith(": upward")
    assert found[1:] == ["circle: low.attic, low.cellar"]


def test_a_circle_is_named_with_all_its_rooms(tmp_path: Path):
    files = {"low/ground.py": "import low.attic.box", "low/attic/box.py": "import low.cellar.wine"}
    assert "circle: low.attic, low.cellar, low.ground" in problems(small(tmp_path, files))


def test_a_package_that_imports_the_one_around_it_is_told(tmp_path: Path):
    assert problems(small(tmp_path, {"low/ground.py": "import high.quiet.reader"})) == [
        "low/ground.py:1: low.ground imports high.quiet.reader: upward, out of low",
        "circle: high.quiet, low.attic, low.cellar, low.ground",
    ]


def test_an_arrow_downwards_that_no_row_names_is_told(tmp_path: Path):
    low = {"ground": "", "cellar": "ground", "attic": "ground"}
    (found,) = problems(small(tmp_path, low=low))
    assert found == "low/attic/box.py:1: low.attic.box imports low.cellar.wine: the row of attic does not name cellar"


def test_a_room_without_a_row_a_row_without_a_room_and_a_row_that_looks_upward_are_told(tmp_path: Path):
    low = {"ground": "cellar", "cellar": "ground", "garage": ""}
    assert problems(small(tmp_path, low=low)) == [
        "low.attic has no row in the list of rooms",
        "low.garage is in the list of rooms, and is not there",
        "the list lets low.ground import cellar, which stands after it",
    ]


@pytest.mark.parametrize("statement", ["import rclpy", "from sensor_msgs.msg import Image", "import high.noisy.node"])
def test_an_import_of_ros_or_of_what_needs_it_is_named_outside_of_the_rooms_for_it(tmp_path: Path, statement: str):
    found = rooms.misplaced_ros(small(tmp_path, {"high/quiet/reader.py": f"def f():\n    {statement}"}))
    assert len(found) == 1
    assert found[0].startswith("high/quiet/reader.py:2: high.quiet.reader imports ")
    assert found[0].endswith(", which needs ROS")


def test_what_may_import_ros_late_must_not_do_it_at_once(tmp_path: Path):
    (found,) = rooms.misplaced_ros(small(tmp_path, {"high/play.py": "from high.noisy import node"}))
    assert found == "high/play.py:1: high.play imports high.noisy.node, which needs ROS"


def test_core_must_not_know_the_formats_that_the_package_around_it_may(tmp_path: Path):
    (found,) = rooms.misplaced_ros(small(tmp_path, {"low/ground.py": "from rosbags.highlevel import AnyReader"}))
    assert found == "low/ground.py:1: low.ground imports rosbags.highlevel, which is about ROS's formats"


def test_a_module_among_those_with_ros_that_needs_none_is_told(tmp_path: Path):
    (found,) = rooms.misplaced_ros(small(tmp_path, {"high/noisy/sums.py": "import math"}))
    assert found == "high.noisy.sums imports no ROS: its place is a room without ROS"


def test_the_table_has_a_line_for_each_room_with_its_purpose_its_modules_and_its_arrows(tmp_path: Path):
    lines = rooms.table(small(tmp_path)).splitlines()
    assert "| `ground.py` | What all stand on |  |  |" in lines
    assert "| `cellar/` |  | wine | ground |" in lines
    assert "| `quiet/` |  | reader |  | attic |" in lines
    assert "**low**: 3 rooms, 2 arrows" in lines


def test_a_page_without_the_marks_for_the_table_is_refused():
    with pytest.raises(ValueError, match="lacks the marks"):
        rooms.with_table("# Page", "table")
