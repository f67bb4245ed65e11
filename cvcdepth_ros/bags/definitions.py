# SPDX-License-Identifier: Apache-2.0
"""The .msg text that recordings carry of their types, of ROS 1 and ROS 2 alike.

Only the layout is taken from it: comments, constants and default values are passed over, whatever is in them. ROS 1
allows constants with lower-case names, empty texts as constants, and blank lines between parts, and its files have
comments in any character set.
"""

import re
from collections.abc import Iterator
from typing import cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Basename, FieldDesc, NameDesc, Typesdict

NOTHING = "structure_needs_at_least_one_member"
"""What ROS 2 puts into types without fields."""

_NUMBERS = {f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)} | {"float32", "float64"}
_BASE_TYPES = frozenset({"bool", "byte", "char", "string", "wstring"} | _NUMBERS)
_BUILT_IN = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_SEPARATOR = re.compile(r"={10,}\s*")
_CONSTANT = re.compile(r"[\w/]+(<=\d+)?\s+\w+\s*=", re.ASCII)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(<=(?P<letters>\d{1,9}))?"
    r"(?P<array>\[(?P<at_most><=)?(?P<count>\d{0,9})\])?\s+(?P<name>\w+)(\s.*)?",
    re.ASCII,
)


def normal_type_name(name: str) -> str:
    """Return a type's name as ROS 2 writes it (`std_msgs/msg/Header`), of ROS 1's `std_msgs/Header` too."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def types_of_msg(text: str, type_name: str) -> Typesdict:
    """Return the types that a definition lays out: `type_name` and those that follow it, by name.

    Raises ValueError, naming the line, for one that is neither a field nor anything to be passed over.
    """
    types: Typesdict = {}
    name = normal_type_name(type_name)
    awaits_name = False
    for line in _lines(text):
        if _SEPARATOR.fullmatch(line):
            awaits_name = True
        elif awaits_name:
            name, awaits_name = _part_name(line), False
            types[name] = [], []
        elif not _CONSTANT.match(line):
            types.setdefault(name, ([], []))[1].append(_field(line, name))
    types.setdefault(normal_type_name(type_name), ([], []))
    for _, fields in types.values():
        if not fields:
            fields.append((NOTHING, (Nodetype.BASE, ("uint8", 0))))
    return types


def _lines(text: str) -> Iterator[str]:
    """Give what is left of each line without its comment, if anything is; annotations lay out nothing."""
    for line in text.splitlines():
        content = line.partition("#")[0].strip()
        if content and not content.startswith("@"):
            yield content


def _part_name(line: str) -> str:
    kind, _, name = line.partition(":")
    if kind.strip() != "MSG" or not name.strip():
        raise ValueError(f"'{line:.40}' follows a separator, want MSG: and a type")
    return normal_type_name(name.strip())


def _field(line: str, owner: str) -> tuple[str, FieldDesc]:
    found = _FIELD.fullmatch(line)
    if found is None:
        raise ValueError(f"'{line:.40}' is no field")
    element = _element(found["type"], int(found["letters"] or 0), owner)
    if not found["array"]:
        return found["name"], element
    elements = element, int(found["count"] or 0)
    is_sequence = found["at_most"] or not found["count"]
    return found["name"], (Nodetype.SEQUENCE, elements) if is_sequence else (Nodetype.ARRAY, elements)


def _element(name: str, letters: int, owner: str) -> BaseDesc | NameDesc:
    if name in _BASE_TYPES:
        return Nodetype.BASE, (cast(Basename, name), letters)
    name = _BUILT_IN.get(name, name)
    # A name without a package is of the package that refers to it.
    return Nodetype.NAME, normal_type_name(name) if "/" in name else f"{owner.rpartition('/')[0]}/{name}"
