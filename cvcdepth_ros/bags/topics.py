# SPDX-License-Identifier: Apache-2.0
"""What every recording format has in common: topics, messages, and what a reader of one file gives."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.remote import Location

STORAGE_SUFFIXES = (".mcap", ".db3", ".bag", ".mcap.zstd", ".db3.zstd")
"""How the names of storage files end; a file that is named itself may end otherwise."""
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
    """One topic of a recording."""

    name: str
    type: str
    """Message type as ROS 2 writes it: `sensor_msgs/msg/Image`."""
    count: int
    """Number of messages that can be read."""
    qos: tuple[Qos, ...] | None = None
    """The profiles its publishers offered, or None where the recording does not say."""
    definition: str | None = None
    """The message definition (.msg or IDL text, with those it refers to), or None where the recording has none."""

    def joined(self, other: "Topic", where: Location) -> "Topic":
        """Return this topic with the messages of another channel or file of the same recording added.

        Raises RecordingError, naming `where`, when the two have different message types.
        """
        if self.type != other.type:
            raise RecordingError(f"{where}: topic {self.name} has two types, {self.type} and {other.type}")
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


def joined_topics(topics: Collection[Topic], where: Location) -> dict[str, Topic]:
    """Return the topics by name, those that appear more than once joined into one."""
    by_name: dict[str, Topic] = {}
    for topic in topics:
        known = by_name.get(topic.name)
        by_name[topic.name] = known.joined(topic, where) if known else topic
    return by_name


def recorded_qos(text: str | None) -> tuple[Qos, ...] | None:
    """Return the profiles of an `offered_qos_profiles` entry (YAML), None when it is absent, empty or unreadable."""
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
