# SPDX-License-Identifier: Apache-2.0
"""The baseline of `cvcdepth bench`: the node as one writes it at first.

One callback decodes, rectifies, estimates and publishes a set, everything and one after the other, as soon as the set
is complete. Parameters, topics and messages are those of `surround_depth_node`.
"""

import os

from cvcdepth_ros.process_setup import openmp_environment, prepare_process

os.environ.update(openmp_environment())  # before the imports below load torch

import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_ros.bench.baseline_cloud import baseline_cloud
from cvcdepth_ros.live.mailbox import MailboxStatistics
from cvcdepth_ros.messages.conversion import ros_message_class, ros_message_factory, stamp_ns
from cvcdepth_ros.node.diagnostics import inference_status, synchronisation_status
from cvcdepth_ros.node.parameters import declare_parameters, read_parameters
from cvcdepth_ros.node.subscriptions import CameraInputs
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.output_messages import MERGED_CLOUD, OutputLimits, SurroundMessages, output_types
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet, estimate_set
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet, SurroundSynchronizer


class BaselineNode(Node):  # type: ignore[misc] # rclpy is not annotated
    """Turns images into depth in one callback; needs a complete rig file."""

    def __init__(self) -> None:
        super().__init__("surround_depth")
        declare_parameters(self)
        self._settings = read_parameters(self)
        layout = load_rig_layout(Path(self._settings.rig))
        self._frame_ids = {camera.name: camera.frame_id or "" for camera in layout.cameras}
        self._estimator = self._settings.build_estimator()
        self._surround = SurroundDepthEstimator(layout.complete(), self._estimator)
        tolerance = self._settings.tolerance
        self._synchroniser: SurroundSynchronizer[Any] = SurroundSynchronizer.from_layout(layout, tolerance)
        self._factory = ros_message_factory()
        self._messages = SurroundMessages(self._factory, self._settings.depth_encoding)
        self._outputs = {
            topic: self.create_publisher(ros_message_class(type_), f"~/{topic}", 10)
            for topic, type_ in output_types(layout.names).items()
        }
        self._latencies = StageLatencies()
        self._counters = Counter({"published": 0, "refused": 0})
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._inputs = CameraInputs(self, layout, self._settings.reliable, self._on_image, lambda *_: None)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.25, self._inputs.connect, clock=steady)
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)

    def _on_image(self, cameras: list[str], message: Any) -> None:
        stamp = stamp_ns(message)
        for surround_set in [found for name in cameras for found in self._synchroniser.add(name, stamp, message)]:
            try:
                self._handle(surround_set)
            except CvcDepthError as error:
                self.get_logger().error(str(error))
                self._counters["refused"] += 1
            else:
                self._counters["published"] += 1

    def _handle(self, surround_set: SurroundSet[Any]) -> None:
        images, rig, limits = surround_set.images, self._surround.rig, OutputLimits.of(self._settings)
        result = estimate_set(images, self._surround, self._latencies, len(images))
        with self._latencies.measure("postprocess"):
            cloud = baseline_cloud(result, rig, limits.cloud)
            merged = self._factory.point_cloud(surround_set.stamp_ns, rig.base_frame, cloud)
        with self._latencies.measure("publish"):
            self._outputs[MERGED_CLOUD].publish(merged)
            others = self._outputs.keys() - {MERGED_CLOUD}
            estimated = EstimatedSet(surround_set, rig, result)
            for output in self._messages.of_set(estimated, self._frame_ids, limits, others.__contains__):
                self._outputs[output.topic].publish(output.message)

    def _publish_diagnostics(self) -> None:
        statuses = [
            synchronisation_status(self._synchroniser.statistics(), MailboxStatistics(), self._counters),
            inference_status(self._latencies.summaries(), MailboxStatistics(), "", self._estimator.model_id),
        ]
        for entry in statuses:
            entry.name = f"{self.get_name()}: {entry.name}"
            entry.hardware_id = self.get_fully_qualified_name()
        self._diagnostics.publish(DiagnosticArray(status=statuses))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run until interrupted."""
    prepare_process()
    rclpy.init(args=list(sys.argv if arguments is None else arguments))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(BaselineNode())
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
