# SPDX-License-Identifier: Apache-2.0
"""Which message types are known, and how their bytes are laid out."""

import re
from collections.abc import Iterable, Sequence
from functools import cache, lru_cache
from keyword import iskeyword

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs, FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_typestore
from rosbags.typesys.store import Typestore

from cvcdepth_ros.bags.definitions import NOTHING, types_of_msg
from cvcdepth_ros.bags.topics import Topic
from cvcdepth_ros.bags.video import VIDEO_DEFINITIONS

_SEPARATOR = "=" * 80 + "\n"
_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_FIELD_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
# The longest definitions of real messages have some hundred fields and 50 kB, most of it comments.
_MAX_DEFINITION = 2**18
_MAX_FIELDS = 2000


@cache
def typestore() -> Typestore:
    """Return the message types of ROS 2 Jazzy, and those of video streams. It is shared: register nothing in it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in VIDEO_DEFINITIONS.items():
        store.register(types_of_msg(definition, name))
    return store


def typestore_for(topics: Iterable[Topic]) -> Typestore:
    """Return a store that knows the types of `topics` by the definitions they carry.

    It is the shared one when that lays out all of them alike; otherwise the recording's own definitions win, because
    its bytes were written with them. An unreadable definition is passed over; its type is then known only if Jazzy has
    it.
    """
    carried = list(dict.fromkeys((topic.definition, topic.type) for topic in topics))
    own: Typesdict = {}
    for definition, type_name in carried:
        own.update(_own_types(parsed_definition(definition, type_name)))
    if not _can_be_used(own):
        own = _usable_together(carried)
    if not own:
        return typestore()
    store = get_typestore(Stores.EMPTY)
    store.register({**typestore().fielddefs, **own})
    return store


def _own_types(carried: Typesdict) -> Typesdict:
    """Return the types that the shared store does not know, or lays out differently; the built-in ones are its own."""
    shared, built_in = typestore().fielddefs, get_typestore(Stores.EMPTY).fielddefs
    return {
        name: fields
        for name, fields in carried.items()
        if name not in built_in and not _same_layout(shared, name, carried)
    }


def _usable_together(carried: Sequence[tuple[str | None, str]]) -> Typesdict:
    """Return the types of one definition after the other, but for those that make the ones before it unusable."""
    own: Typesdict = {}
    for definition, type_name in carried:
        more = {**own, **_own_types(parsed_definition(definition, type_name))}
        if _can_be_used(more):
            own = more
    return own


def _can_be_used(own: Typesdict) -> bool:
    """Definitions that are complete alone may lead back to each other when one replaces what another relied on."""
    return not own or _are_complete({**typestore().fielddefs, **own})


@lru_cache(maxsize=1024)
def parsed_definition(definition: str | None, type_name: str) -> Typesdict:
    """Return the types of a definition (.msg or IDL text) that a recording carries; nothing where it cannot be used.

    What is returned is kept for the next time: change nothing in it.

    A library makes Python code out of them. Hence constants are left out, and a definition is passed over whole when a
    name in it is no identifier, when it is not complete without itself, or when its code would be without measure.
    """
    if not definition or len(definition) > _MAX_DEFINITION:
        return {}
    try:
        is_idl = definition.startswith(_SEPARATOR + "IDL: ")
        types = _types_of_idl(definition) if is_idl else types_of_msg(definition, type_name)
    except Exception:  # a grammar that meets foreign text may raise anything, RecursionError included
        return {}
    plain: Typesdict = {name: ([], fields) for name, (_, fields) in types.items()}
    return plain if _are_usable(plain) else {}


def _types_of_idl(definition: str) -> Typesdict:
    """Return the types of rosbag2's bundle of IDL files: each is headed by a line of `=` and a line `IDL: name`."""
    types: Typesdict = {}
    for part in definition.split(_SEPARATOR)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def _are_usable(types: Typesdict) -> bool:
    fields = [field for _, fields in types.values() for field in fields]
    names = all(map(_TYPE_NAME.fullmatch, types)) and all(_FIELD_NAME.fullmatch(name) for name, _ in fields)
    unrolled = sum(_unrolled(kind) for _, kind in fields)
    distinct = all(_have_own_names(fields) for _, fields in types.values())
    of_measure = len(fields) <= _MAX_FIELDS and unrolled <= _MAX_FIELDS
    return names and distinct and of_measure and _are_complete(types) and not _repeats_nothing(types)


def _have_own_names(fields: Fielddefs) -> bool:
    """Say whether no two fields of a type become one attribute; those called like a keyword get an underscore."""
    return len({name + "_" * iskeyword(name) for name, _ in fields}) == len(fields)


def _unrolled(kind: FieldDesc) -> int:
    """Count the elements of a fixed array that get code of their own: all but numbers."""
    if kind[0] != Nodetype.ARRAY:
        return 0
    element, count = kind[1]
    is_number = element[0] == Nodetype.BASE and element[1][0] not in ("string", "wstring")
    return 0 if is_number else count


def _repeats_nothing(types: Typesdict) -> bool:
    """Say whether a sequence has elements without bytes: four bytes would say that there are billions of them."""
    known = {name for name, (_, fields) in typestore().fielddefs.items() if all(name == NOTHING for name, _ in fields)}
    empty = known - types.keys()
    while more := {name for name in types.keys() - empty if all(_is_nothing(field, empty) for field in types[name][1])}:
        empty |= more
    fields = [kind for _, kinds in types.values() for _, kind in kinds]
    return any(kind[0] == Nodetype.SEQUENCE and part_of(kind) in empty for kind in fields)


def _is_nothing(field: tuple[str, FieldDesc], empty: set[str]) -> bool:
    """Say whether a field takes no byte in a ROS 1 message, `empty` being types that take none."""
    name, kind = field
    without_elements = kind[0] == Nodetype.ARRAY and kind[1][1] == 0
    return name == NOTHING or without_elements or (kind[0] != Nodetype.SEQUENCE and part_of(kind) in empty)


def _are_complete(types: Typesdict) -> bool:
    """Say whether every type consists of known ones and, in the end, of no part of itself."""
    known = typestore().fielddefs
    waiting = {
        name: {part for _, kind in fields if (part := part_of(kind)) is not None and part not in known.keys() - types}
        for name, (_, fields) in types.items()
    }
    while ready := {name for name, parts in waiting.items() if not parts}:
        waiting = {name: parts - ready for name, parts in waiting.items() if name not in ready}
    return not waiting


def part_of(kind: FieldDesc) -> str | None:
    """Return the type that a field, or each of its elements, is of; None for numbers and text."""
    element = kind[1][0] if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind
    return str(element[1]) if element[0] == Nodetype.NAME else None


def _same_layout(shared: Typesdict, name: str, carried: Typesdict) -> bool:
    """ROS 1 capitalises some fields (CameraInfo's K) that ROS 2 does not; the bytes are the same."""

    def layout(types: Typesdict) -> list[tuple[str, object]]:
        return [(field.lower(), kind) for field, kind in types[name][1]]

    return name in shared and layout(shared) == layout(carried)
