# SPDX-License-Identifier: Apache-2.0
"""Who may import whom: the rooms, what breaks their walls, and the table in docs/architecture.md.

    python tools/rooms.py            # print the table, made from the imports themselves, and every broken wall
    python tools/rooms.py --write    # put the table into docs/architecture.md

A room is a folder or a module right below a package. The rooms stand on floors: each may import only those that its row
names, and all of these stand before it in the list, so that there is no upward arrow and no circle. An import counts
wherever it stands, in a function and for a type annotation too.
"""

import argparse
import ast
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- rooms: made by tools/rooms.py --write -->", "<!-- rooms: end -->"

ROS = re.compile(
    r"rclpy|rosbag2_py|message_filters|cv_bridge|launch(_ros)?|(ament|rosidl|tf2)_\w+|\w+_(msgs|srvs|interfaces|msgs_py)"
)
FORMATS = re.compile(r"rosbags|mcap|mcap_\w+")
"""Packages that know how ROS stores messages: those, and no ROS, are for the package around core."""

# From the ground floor up: the room, and the rooms that it may import.
_GROUND = "errors stamps files processor model_choices surround_depth"

CORE_ROOMS = {
    "errors": "",
    "stamps": "errors",
    "files": "errors",
    "processor": "",
    "model_choices": "errors",
    "surround_depth": "",
    "sky": _GROUND,
    "rig": _GROUND,
    "images": f"{_GROUND} rig",
    "networks": f"{_GROUND} images",
    "engines": f"{_GROUND} images networks",
    "rendering": f"{_GROUND} rig images",
    "training": f"{_GROUND} rig networks rendering",
    "pointcloud": f"{_GROUND} rig",
    "obstacles": f"{_GROUND} rig pointcloud",
    "scoring": f"{_GROUND} rig images rendering training pointcloud obstacles",
    "rig_health": f"{_GROUND} rig images rendering scoring",
    "estimator": f"{_GROUND} sky rig images networks engines",
    "visualization": f"{_GROUND} rig images",
    "worlds": f"{_GROUND} rig",
    "refinement": f"{_GROUND} rig images rendering",
}
ROS_ROOMS = {
    "installation": "",
    "process_setup": "installation",
    "settings": "",
    "console": "",
    "recently_used": "",
    "bags": "recently_used",
    "kept": "bags",
    "messages": "bags",
    "surround_sets": "settings messages",
    "recordings": "settings bags kept messages surround_sets",
    "live": "messages surround_sets",
    "training_data": "settings recently_used bags kept messages surround_sets recordings",
    "checks": "settings bags messages surround_sets recordings training_data",
    "evaluation": "installation process_setup settings console bags kept messages surround_sets recordings",
    "node": "process_setup settings bags messages surround_sets live",
    "simulation": "installation bags messages",
    "finetuning": "installation settings console bags kept surround_sets recordings checks training_data evaluation",
    "end_to_end": "installation process_setup console bags messages surround_sets live node",
    "bench": "process_setup messages surround_sets live node",
    "reports": "console messages evaluation finetuning",
    "commands": "installation process_setup settings console bags kept messages surround_sets recordings live checks "
    "training_data evaluation node simulation finetuning end_to_end bench reports",
    "demo": "installation settings console bags messages surround_sets recordings end_to_end reports",
    "bag_replay": "installation process_setup console commands",
    "surround_depth_node": "process_setup settings node",
}


class House(NamedTuple):
    """The packages and their rooms, lower ones first, and where ROS may be imported."""

    packages: Mapping[str, Mapping[str, str]]
    """Package -> room -> the rooms of the same package that it may import. All of a lower package may be imported."""
    needs_ros: Sequence[str] = ()
    """Patterns of the modules that import ROS, each of them."""
    needs_ros_late: Sequence[str] = ()
    """Patterns of those that import ROS, or what needs it, only when a function is called."""


HOUSE = House(
    {"cvcdepth_core": CORE_ROOMS, "cvcdepth_ros": ROS_ROOMS},
    (
        "cvcdepth_ros.node.*",
        "cvcdepth_ros.bench.*_node",
        "cvcdepth_ros.end_to_end.recorder",
    ),
    ("cvcdepth_ros.commands.play", "cvcdepth_ros.surround_depth_node"),
)


class Import(NamedTuple):
    """One import of one module."""

    importer: str
    imported: str
    """A module of the tree, or the name of something that is not in it."""
    line: int
    is_late: bool
    """Whether it is made only when a function is called, or for type checkers."""


class Arrow(NamedTuple):
    """A room that imports another, each as package.room."""

    importer: str
    imported: str


class Tree:
    """The modules of a house and what they import."""

    def __init__(self, root: Path, house: House = HOUSE) -> None:
        self.root, self.house = root, house
        self.modules = {name: path for package in house.packages for name, path in _modules(root, package)}
        self.imports = [found for name, path in self.modules.items() for found in _imports(name, path, self.modules)]

    def is_folder(self, name: str) -> bool:
        """Whether the module is the `__init__` of a folder."""
        return self.modules[name].name == "__init__.py"

    def rooms(self, package: str) -> dict[str, list[str]]:
        """Return the modules of every room that there is, in the order of the list, unknown rooms last."""
        found: dict[str, list[str]] = {}
        for module in self.modules:
            if module.startswith(f"{package}."):
                found.setdefault(_room(module), []).append(module)
        known = [f"{package}.{room}" for room in self.house.packages[package]]
        return {room: found[room] for room in [*known, *sorted(found.keys() - known)] if room in found}

    def arrows(self) -> dict[Arrow, list[Import]]:
        """Return which room imports which other, and where."""
        found: dict[Arrow, list[Import]] = {}
        for entry in self.imports:
            arrow = Arrow(_room(entry.importer), _room(entry.imported))
            if entry.imported in self.modules and arrow.imported not in (arrow.importer, _top(arrow.imported)):
                found.setdefault(arrow, []).append(entry)
        return found

    def told(self, entry: Import) -> str:
        """Name an import with its file and line."""
        place = f"{self.modules[entry.importer].relative_to(self.root)}:{entry.line}"
        return f"{place}: {entry.importer} imports {entry.imported}"


def broken_walls(tree: Tree) -> list[str]:
    """Name every import that the list of rooms does not allow, every circle, and what is wrong with the list itself."""
    arrows = tree.arrows()
    forbidden = [
        f"{tree.told(entry)}: {reason}"
        for arrow, entries in arrows.items()
        if (reason := _why_forbidden(arrow, tree.house))
        for entry in entries
    ]
    return [*_wrong_rows(tree), *forbidden, *_circles(arrows)]


def misplaced_ros(tree: Tree) -> list[str]:
    """Name every import of ROS, and in the lowest package of ROS's formats, that stands where it must not."""
    house, lowest = tree.house, next(iter(tree.house.packages))
    needing = {name for name in tree.modules if _matches(name, house.needs_ros)}
    found = []
    for entry in tree.imports:
        if _is_ros(entry.imported) or entry.imported in needing:
            is_late = entry.is_late and _matches(entry.importer, house.needs_ros_late)
            if entry.importer not in needing and not is_late:
                found.append(f"{tree.told(entry)}, which needs ROS")
        elif FORMATS.fullmatch(_top(entry.imported)) and _top(entry.importer) == lowest:
            found.append(f"{tree.told(entry)}, which is about ROS's formats")
    return [*found, *_idle_exceptions(tree)]


def _idle_exceptions(tree: Tree) -> Iterator[str]:
    """Name the modules that may import ROS and do not, and the patterns that fit no module."""
    with_ros = {entry.importer for entry in tree.imports if _is_ros(entry.imported)}
    for name in tree.modules:
        if _matches(name, tree.house.needs_ros) and name not in with_ros and not tree.is_folder(name):
            yield f"{name} imports no ROS: its place is a room without ROS"
    for pattern in (*tree.house.needs_ros, *tree.house.needs_ros_late):
        if not any(_matches(name, [pattern]) for name in tree.modules):
            yield f"no module is called {pattern}"


def table(tree: Tree) -> str:
    """Return Markdown: for each package a line for every room with what it is for, its modules, and what it imports."""
    return "\n".join(line for package in tree.house.packages for line in _package_table(tree, package))


def with_table(page: str, rooms: str) -> str:
    """Return the page with this table between its marks; ValueError where the marks are not there."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"the page lacks the marks {BEGIN} and {END}")
    return f"{before}{begin}\n\n{rooms}\n{end}{after}"


def _package_table(tree: Tree, package: str) -> Iterator[str]:
    packages, arrows = list(tree.house.packages), tree.arrows()
    below = packages[: packages.index(package)]
    inner = [arrow for arrow in arrows if _top(arrow.importer) == _top(arrow.imported) == package]
    yield f"**{package}**: {len(tree.rooms(package))} rooms, {len(inner)} arrows\n"
    yield f"| room | what it is | modules | imports |{''.join(f' imports of {other} |' for other in below)}"
    yield "|---|---|---|---|" + "---|" * len(below)
    for room, modules in tree.rooms(package).items():
        targets = {arrow.imported for arrow in arrows if arrow.importer == room}
        cells = [
            f"`{_short(room)}/`" if tree.is_folder(room) else f"`{_short(room)}.py`",
            _purpose(tree.modules[room]),
            ", ".join(_short(module) for module in modules if module != room),
            *(", ".join(_short(t) for t in tree.rooms(other) if t in targets) for other in (package, *below)),
        ]
        yield f"| {' | '.join(cells)} |"
    yield ""


def _wrong_rows(tree: Tree) -> Iterator[str]:
    for package, rows in tree.house.packages.items():
        rooms = [_short(room) for room in tree.rooms(package)]
        yield from (f"{package}.{room} has no row in the list of rooms" for room in rooms if room not in rows)
        yield from (f"{package}.{room} is in the list of rooms, and is not there" for room in rows if room not in rooms)
        order = list(rows)
        for number, (room, allowed) in enumerate(rows.items()):
            wrong = [other for other in allowed.split() if other not in order[:number]]
            yield from (f"the list lets {package}.{room} import {other}, which stands after it" for other in wrong)


def _why_forbidden(arrow: Arrow, house: House) -> str:
    """Say why a room must not import the other; nothing where it may, or has no row."""
    packages, (above, below) = list(house.packages), (_top(arrow.importer), _top(arrow.imported))
    if above != below:
        return "" if packages.index(below) < packages.index(above) else f"upward, out of {above}"
    rows = house.packages[above]
    importer, imported = _short(arrow.importer), _short(arrow.imported)
    if importer not in rows or imported not in rows or imported in rows[importer].split():
        return ""
    order = list(rows)
    is_upward = order.index(imported) > order.index(importer)
    return "upward" if is_upward else f"the row of {importer} does not name {imported}"


def _circles(arrows: Collection[Arrow]) -> Iterator[str]:
    """Name the rooms that reach themselves, those that reach each other together."""
    reached = {room: {arrow.imported for arrow in arrows if arrow.importer == room} for room in sum(arrows, ())}
    for through in reached:
        for room, others in reached.items():
            reached[room] = others | (reached[through] if through in others else set())
    circles = {tuple(sorted(other for other in reached[room] if room in reached[other])) for room in sorted(reached)}
    yield from (f"circle: {', '.join(circle)}" for circle in sorted(circles - {()}))


def _modules(root: Path, package: str) -> Iterator[tuple[str, Path]]:
    for path in sorted((root / package).rglob("*.py")):
        yield ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"), path


def _imports(name: str, path: Path, modules: Collection[str]) -> Iterator[Import]:
    parent = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node, is_late in _nodes(ast.parse(path.read_text(encoding="utf-8"))):
        for imported in sorted(_imported(node, parent, modules)):
            yield Import(name, imported, node.lineno, is_late)


def _nodes(node: ast.AST, is_late: bool = False) -> Iterator[tuple[ast.stmt, bool]]:
    """Give every import statement, and whether it is made only when a function is called, or for type checkers."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, is_late
        defers = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        is_for_types = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
        yield from _nodes(child, is_late or defers or is_for_types)


def _imported(node: ast.stmt, parent: str, modules: Collection[str]) -> set[str]:
    """Return what an import statement in the package `parent` imports; of names that are no modules, their module."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if not isinstance(node, ast.ImportFrom):
        return set()
    source = node.module or ""
    if node.level:
        base = parent.split(".")[: len(parent.split(".")) - node.level + 1]
        source = ".".join([*base, source] if source else base)
    inner = {f"{source}.{alias.name}" for alias in node.names}
    return {name if name in modules else source for name in inner}


def _purpose(path: Path) -> str:
    """Return the first sentence of a module's docstring."""
    text = " ".join((ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split())
    return re.split(r"(?<=[.?!]) (?=[A-Z`])", text)[0].rstrip(".")


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _is_ros(name: str) -> bool:
    return ROS.fullmatch(_top(name)) is not None


def _top(name: str) -> str:
    return name.partition(".")[0]


def _room(module: str) -> str:
    return ".".join(module.split(".")[:2])


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and every broken wall, or write the table; 1 where a wall is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    tree = Tree(ROOT)
    if options.write:
        PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), table(tree)), encoding="utf-8")
    else:
        print(table(tree))
    problems = [*broken_walls(tree), *misplaced_ros(tree)]
    print("\n".join(problems), file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
