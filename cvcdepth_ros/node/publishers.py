# SPDX-License-Identifier: Apache-2.0
"""The node's publishers; outputs without subscribers are not computed."""

import time
from collections.abc import Mapping
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.obstacles.ground import GroundPlane
from cvcdepth_ros.messages.conversion import ros_message_class, ros_message_factory
from cvcdepth_ros.node.qos import refusing_impossible_qos
from cvcdepth_ros.settings import NodeParameters
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.output_messages import (
    CONFIDENCE,
    OutputLimits,
    SurroundMessages,
    camera_topics,
    output_types,
)
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet


class SurroundOutputs:
    """Publishes one set's depth, pictures and clouds under the node's private names."""

    def __init__(self, node: Node, cameras: list[str], parameters: NodeParameters, latencies: StageLatencies) -> None:
        """Advertise; ConfigError names a topic that cannot be."""
        self._cameras = cameras
        self._node = node
        self._latencies = latencies
        self._messages = SurroundMessages(
            ros_message_factory(), parameters.depth_encoding, parameters.depth_min_confidence, parameters.sky
        )
        self._publishers: dict[str, Publisher] = {}
        try:
            for topic, type_name in output_types(cameras, parameters.publish_odometry).items():
                self._publishers[topic] = self._publisher(topic, type_name)
        except ConfigError:
            self.close()
            raise

    def wanted(self, camera: str) -> bool:
        """Return whether a topic is subscribed for which this camera's depth is needed."""
        return any(map(self._has_subscribers, camera_topics(camera)))

    def wants_confidence(self) -> bool:
        """Return whether any camera's confidence is subscribed."""
        return any(self._has_subscribers(f"{camera}/{CONFIDENCE}") for camera in self._cameras)

    @property
    def ground(self) -> GroundPlane | None:
        """The ground of the last set whose obstacles were asked for; None before any."""
        return self._messages.ground

    @property
    def deskewed(self) -> bool | None:
        """Whether the points of the last merged cloud were moved to its moment; None before any."""
        return self._messages.deskewed

    def publish(self, estimated: EstimatedSet[Any], frame_ids: Mapping[str, str], limits: OutputLimits) -> None:
        """Publish one set; see `SurroundMessages.of_set` for stamps and frames.

        Each message leaves as soon as it is built: depth does not wait for the clouds.
        """
        building = publishing = 0.0
        began = time.monotonic()
        for output in self._messages.of_set(estimated, frame_ids, limits, self._has_subscribers):
            built = time.monotonic()
            self._publishers[output.topic].publish(output.message)
            published = time.monotonic()
            self._latencies.trace("postprocess", began, built)
            self._latencies.trace("publish", built, published)
            building, publishing, began = building + built - began, publishing + published - built, published
        self._latencies.record("postprocess", building)
        self._latencies.record("publish", publishing)

    def close(self) -> None:
        """Drop all publishers."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def _has_subscribers(self, topic: str) -> bool:
        publisher = self._publishers.get(topic)  # not all are advertised
        return publisher is not None and bool(publisher.get_subscription_count())

    def _publisher(self, topic: str, type_name: str) -> Publisher:
        with refusing_impossible_qos(topic):
            return self._node.create_publisher(
                ros_message_class(type_name),
                f"~/{topic}",
                # Overrides are written into the profile that is handed over: each publisher needs its own.
                QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
