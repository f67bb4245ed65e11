# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 1, whatever file they are in: their types become those of ROS 2, their bytes CDR."""

import struct
from collections.abc import Callable, Iterable
from functools import cache, lru_cache, partial

from rosbags.interfaces.typing import Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from cvcdepth_ros.bags.topics import Topic
from cvcdepth_ros.bags.typestores import parsed_definition, part_of, typestore, typestore_for

# The types that ROS 1 lays out differently (the header has a sequence number there) or has built in.
_ROS2_TYPES = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
# What the converter raises on bytes that do not fit; it checks some lengths by assertion.
_MISFIT = (SerdeError, ValueError, struct.error, LookupError, AssertionError, OverflowError, MemoryError)


@lru_cache(maxsize=1024)
def ros1_definition(text: str, type_name: str) -> str:
    """Return the definition in ROS 2's form, of which the converter makes use.

    Raises ValueError where the text cannot be used (relays record none, but a placeholder) and the type is none that
    every ROS 1 system has.
    """
    types = parsed_definition(text, type_name)
    if type_name not in types:
        types = {}
    store = get_typestore(Stores.EMPTY)
    store.register(_with_parts({**types, **_ros2_types()}, type_name))
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return definition or "\n"


class Ros1Converter:
    """Converts the messages of some topics to CDR, by the definitions that `ros1_definition` returned."""

    def __init__(self, topics: Iterable[Topic]) -> None:
        self._topics = [*topics]
        self._store: Typestore | None = None

    def to_cdr(self, type_name: str) -> Callable[[bytes], bytes | memoryview]:
        """Return the converter of one type's messages; it raises ValueError for bytes that are no such message."""
        return partial(self._converted, type_name)

    def _converted(self, type_name: str, raw: bytes) -> memoryview:
        self._store = self._store or typestore_for(self._topics)
        try:
            return self._store.ros1_to_cdr(raw, type_name)
        except _MISFIT as error:
            raise ValueError(f"{len(raw)} bytes that are no {type_name}: {error}") from error


def _with_parts(types: Typesdict, name: str) -> Typesdict:
    """Return a type with all that it consists of; what `types` lacks is of ROS 1's common packages, or of ROS 2's."""
    found: Typesdict = {}
    waiting = [name]
    while waiting:
        part = waiting.pop()
        if part in found:
            continue
        fields = next((known[part] for known in (types, _common_types(), typestore().fielddefs) if part in known), None)
        if fields is None:
            raise ValueError(
                f"the definition of {name} is missing, not complete, has elements without bytes, or is none"
            )
        found[part] = fields
        waiting += [inner for _, kind in fields[1] if (inner := part_of(kind)) is not None]
    return found


@cache
def _common_types() -> Typesdict:
    return get_typestore(Stores.ROS1_NOETIC).fielddefs


@cache
def _ros2_types() -> Typesdict:
    return {name: typestore().fielddefs[name] for name in _ROS2_TYPES}
