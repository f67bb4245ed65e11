# SPDX-License-Identifier: Apache-2.0
"""Quality of service of the node's topics, each of which `qos_overrides` can change."""

from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

try:
    from rclpy.event_handler import SubscriptionEventCallbacks as SubscriptionEventCallbacks
except ImportError:  # ROS 2 Humble calls the module so, and has no event for matching
    from rclpy.qos_event import SubscriptionEventCallbacks as SubscriptionEventCallbacks

from cvcdepth_core.errors import ConfigError

INPUT_DEPTH = 10
"""Messages: one second of a 10 Hz camera."""


def input_qos(reliable: bool, depth: int = INPUT_DEPTH) -> QoSProfile:
    """Return sensor-data QoS with room for so many messages, reliable where asked for."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


@contextmanager
def refusing_impossible_qos(topic: str) -> Iterator[None]:
    """Turn what rclpy raises for the qos_overrides of `topic`, in many kinds, into a ConfigError that names it."""
    try:
        yield
    except Exception as error:
        raise ConfigError(f"{topic}: {error}; see its qos_overrides") from error
