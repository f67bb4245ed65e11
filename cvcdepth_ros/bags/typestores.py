# SPDX-License-Identifier: Apache-2.0
"""Which message types are known, and how their bytes are laid out."""

from collections.abc import Iterable
from functools import cache

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cvcdepth_ros.bags.topics import Topic

_SEPARATOR = "=" * 80 + "\n"


@cache
def typestore() -> Typestore:
    """Return the message types of ROS 2 Jazzy. It is shared: register nothing in it."""
    return get_typestore(Stores.ROS2_JAZZY)


def typestore_for(topics: Iterable[Topic]) -> Typestore:
    """Return a store that knows the types of `topics` by the definitions they carry.

    It is the shared one when that lays out all of them alike; otherwise the recording's own definitions win, because
    its bytes were written with them. An unreadable definition is passed over; its type is then known only if Jazzy has
    it.
    """
    carried: Typesdict = {}
    for topic in topics:
        carried.update(_types_of(topic))
    shared = typestore().fielddefs
    own = {name: fields for name, fields in carried.items() if not _same_layout(shared, name, carried)}
    if not own:
        return typestore()
    store = get_typestore(Stores.EMPTY)
    store.register({**shared, **own})
    return store


def _types_of(topic: Topic) -> Typesdict:
    try:
        if topic.definition and topic.definition.startswith(_SEPARATOR + "IDL: "):
            return _types_of_idl(topic.definition)
        return get_types_from_msg(topic.definition, topic.type) if topic.definition else {}
    except TypesysError:
        return {}


def _types_of_idl(definition: str) -> Typesdict:
    """Return the types of rosbag2's bundle of IDL files: each is headed by a line of `=` and a line `IDL: name`."""
    types: Typesdict = {}
    for part in definition.split(_SEPARATOR)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def _same_layout(shared: Typesdict, name: str, carried: Typesdict) -> bool:
    """ROS 1 capitalises some fields (CameraInfo's K) that ROS 2 does not; the bytes are the same."""

    def layout(types: Typesdict) -> list[tuple[str, object]]:
        return [(field.lower(), kind) for field, kind in types[name][1]]

    return name in shared and layout(shared) == layout(carried)
