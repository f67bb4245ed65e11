# SPDX-License-Identifier: Apache-2.0
"""What every recording format has in common: topics, messages, and what a reader of one file gives."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from cvcdepth_ros.bags.remote import Location

STORAGE_SUFFIXES = (".mcap", ".db3", ".bag", ".bag.active", ".mcap.zstd", ".db3.zstd")
"""How the names of storage files end; a file that is named itself may end otherwise. ROS 1 leaves .bag.active where the
recorder died."""
FOREVER = 2**63 - 1
"""A log time (ns) that no message has."""
MAX_BLOCK_BYTES = 256 * 2**20
"""Of a record, or of an unpacked chunk; recorders write chunks of 1 to 16 MiB, longer only for a longer message."""
# A profile takes some 300 characters, and there is one for each publisher of the topic.
_MAX_QOS = 2**18


class RecordedMessage(NamedTuple):
    """One message as it was recorded."""

    topic: str
    log_time: int
    """When it was recorded, ns since the epoch."""
    cdr: bytes | memoryview
    """The serialised message with its four-byte encapsulation header, whatever format the recording has."""


@dataclass(frozen=True)
class Topic:
    """One topic of a recording. Where messages of two types were recorded under one name, these are two topics."""

    name: str
    """Unique; of the two topics under one name, that with fewer messages has its type behind it, in parentheses."""
    type: str
    """Message type as ROS 2 writes it: `sensor_msgs/msg/Image`."""
    count: int
    """Number of messages that can be read."""
    qos: tuple[Qos, ...] | None = None
    """The profiles its publishers offered, or None where the recording does not say."""
    definition: str | None = None
    """The message definition (.msg or IDL text, with those it refers to), or None where the recording has none."""
    recorded_name: str = ""
    """What the recording calls it, where that is not `name`."""

    def joined(self, other: "Topic") -> "Topic":
        """Return this topic with the messages of another channel or file of the same recording and type added."""
        profiles = dict.fromkeys((self.qos or ()) + (other.qos or ()))
        return replace(
            self,
            count=self.count + other.count,
            qos=tuple(profiles) or None,
            definition=self.definition or other.definition,
        )


class RecordingFile(ABC):
    """A reader of one file. It keeps no file open between calls, so a recording may have any number of files."""

    topics: dict[str, Topic]
    start: int | None
    """Log time of the first message, ns; None when the file holds no message."""
    end: int | None
    """Log time of the last message, ns."""
    size: int
    """Bytes."""
    indexed: bool = True
    """Whether the file told where its messages are; else it was read through once to find them."""

    def __init__(self, path: Location) -> None:
        self.path = path
        self.damage: list[str] = []
        """What could not be read; grows while messages are read."""

    @abstractmethod
    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` with start <= log_time < stop, in time order."""

    def _report(self, damage: str, error: BaseException | None = None) -> None:
        """Add to `damage`, once however often it is met."""
        if error is not None:
            damage = f"{damage} ({error_text(error)})"
        if damage not in self.damage:
            self.damage.append(damage)


def error_text(error: BaseException) -> str:
    """Return the error's message; damaged bytes also raise errors that have none, or nothing but a missing key."""
    return f"{type(error).__name__} {error}".strip() if isinstance(error, LookupError) or not str(error) else str(error)


def joined_topics(topics: Sequence[Topic]) -> tuple[dict[str, Topic], list[str]]:
    """Join those that appear more than once; return the topics by name, and the name of each that was given.

    Names stay as they are but where a topic has two types: there all but the type with the most messages are renamed.
    """
    keys = [(topic.recorded_name or topic.name, topic.type) for topic in topics]
    joined: dict[tuple[str, str], Topic] = {}
    for key, topic in zip(keys, topics, strict=True):
        joined[key] = joined[key].joined(topic) if key in joined else topic
    names = _unique_names({key: topic.count for key, topic in joined.items()})
    by_name = {names[key]: _renamed(topic, key[0], names[key]) for key, topic in joined.items()}
    return by_name, [names[key] for key in keys]


def _unique_names(counts: dict[tuple[str, str], int]) -> dict[tuple[str, str], str]:
    most: dict[str, str] = {}  # name -> the type with the most messages
    for (name, type_), count in counts.items():
        if name not in most or count > counts[name, most[name]]:
            most[name] = type_
    return {(name, type_): name if most[name] == type_ else f"{name} ({type_})" for name, type_ in counts}


def _renamed(topic: Topic, recorded_name: str, name: str) -> Topic:
    return replace(topic, name=name, recorded_name="" if name == recorded_name else recorded_name)


@lru_cache(maxsize=256)
def recorded_qos(text: str | None) -> tuple[Qos, ...] | None:
    """Return the profiles of an `offered_qos_profiles` entry (YAML), None when it is absent, empty or unreadable.

    Thousands of topics have a few texts between them, and the parser takes milliseconds for each.
    """
    # Recorders write no anchors. With them, a few lines of YAML can merge into billions of entries.
    if not text or "&" in text or len(text) > _MAX_QOS:
        return None
    try:
        return tuple(parse_qos(text)) or None
    except (ReaderError, LookupError, TypeError, AttributeError, ValueError, RecursionError):
        return None


def qos_profile(
    depth: int = 10,
    reliability: QosReliability = QosReliability.RELIABLE,
    durability: QosDurability = QosDurability.VOLATILE,
) -> Qos:
    """Return a keep-last profile without deadline or lifespan."""
    unlimited = QosTime(0, 0)
    liveliness = QosLiveliness.AUTOMATIC
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, unlimited, unlimited, liveliness, unlimited, False)


LATCHED = qos_profile(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
"""What /tf_static is published with: whoever subscribes later still gets it."""
