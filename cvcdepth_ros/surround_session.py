# SPDX-License-Identifier: Apache-2.0
"""What runs while the node is active: images in, sets matched, depth estimated on a worker thread, results out."""

import threading
import time
from collections import Counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from cvcdepth_core.errors import CvcDepthError, TransformError
from cvcdepth_core.estimator import DepthEstimator, SurroundDepth, SurroundDepthEstimator
from cvcdepth_core.rig import RigLayout
from cvcdepth_ros.diagnostics import ERROR, OK, camera_status, latency_status, synchronisation_status
from cvcdepth_ros.inputs import CameraInputs, ReceivedImage, StaticTransformInput
from cvcdepth_ros.latencies import StageLatencies
from cvcdepth_ros.mailbox import Mailbox
from cvcdepth_ros.messages import stamp_ns
from cvcdepth_ros.node_parameters import NodeParameters, read_parameters
from cvcdepth_ros.outputs import SurroundOutputs
from cvcdepth_ros.rig_assembly import RigAssembler
from cvcdepth_ros.set_estimation import estimate_set
from cvcdepth_ros.synchronizer import SurroundSet, SurroundSynchronizer

_WORKER_JOIN_SECONDS = 1.0


class SurroundSession:
    """Subscriptions, synchroniser, worker thread and publishers of one active period.

    Callbacks run on the executor's thread and only sort images into sets; everything heavy is the worker's, which
    always takes the newest complete set.
    """

    def __init__(self, node: Node, layout: RigLayout, estimator: DepthEstimator, parameters: NodeParameters) -> None:
        """Subscribe, advertise and start the worker; ConfigError names a parameter that does not fit the rig."""
        self._node = node
        self._estimator = estimator
        self._assembler = RigAssembler(layout)
        self._surround: SurroundDepthEstimator | None = None
        self._rig_problem = ""
        self._set_problem = ""
        self._counters = Counter(
            {"published": 0, "skipped: rig not complete": 0, "skipped: no subscriber": 0, "refused": 0}
        )
        self.latencies = StageLatencies()
        self._synchroniser: SurroundSynchronizer[ReceivedImage] = SurroundSynchronizer.of_rig(
            layout, parameters.tolerance, parameters.queue_size
        )
        self._mailbox: Mailbox[ReceivedImage] = Mailbox(
            parameters.max_age or None, lambda: int(node.get_clock().now().nanoseconds)
        )
        self._transforms = self._listen_for_transforms()
        self._outputs = SurroundOutputs(node, layout.names, parameters.depth_encoding)
        self._inputs = CameraInputs(node, layout, parameters.reliable, self._on_image, self._on_camera_info)
        self._rebuild()
        self._worker = threading.Thread(target=self._work, name="surround_depth_worker", daemon=True)
        self._worker.start()

    def poll(self) -> None:
        """Subscribe image topics that have appeared."""
        self._inputs.connect()

    def close(self) -> bool:
        """Stop everything; False when the worker is still busy with its last set a second later."""
        self._inputs.close()
        if self._transforms is not None:
            self._transforms.close()
        self._mailbox.close()
        self._worker.join(_WORKER_JOIN_SECONDS)
        if self._worker.is_alive():
            return False
        self._outputs.close()
        return True

    def problems(self) -> dict[str, str]:
        """Say for each camera why nothing comes of it, the most basic reason first."""
        rig_problems = {name: self._rig_problem for name in self._assembler.layout.names if self._rig_problem}
        return rig_problems | self._assembler.problems() | dict(self._inputs.problems())

    def diagnostics(self) -> list[DiagnosticStatus]:
        """Describe cameras, synchronisation and inference."""
        problems, statistics = self.problems(), self._synchroniser.statistics()
        cameras = [
            camera_status(name, problems.get(name), statistics.cameras[name], self._inputs.lost[name])
            for name in self._assembler.layout.names
        ]
        inference = latency_status(
            self.latencies.summaries(),
            ERROR if self._set_problem else OK,
            self._set_problem or self._estimator.model_id,
        )
        return [*cameras, synchronisation_status(statistics, self._mailbox.statistics(), self._counters), inference]

    def _listen_for_transforms(self) -> StaticTransformInput | None:
        if all(camera.base_T_camera is not None for camera in self._assembler.layout.cameras):
            return None
        return StaticTransformInput(self._node, self._on_transforms)

    def _on_image(self, camera: str, image: ReceivedImage) -> None:
        for surround_set in self._synchroniser.add(camera, stamp_ns(image.message), image):
            self._mailbox.put(surround_set)

    def _on_camera_info(self, camera: str, message: Any) -> None:
        if self._assembler.add_camera_info(camera, message):
            self._rebuild()

    def _on_transforms(self, message: Any) -> None:
        try:
            self._assembler.transforms.add_message(message)
        except TransformError as error:
            self._node.get_logger().error(f"/tf_static: {error}")
        if self._surround is None:
            self._rebuild()

    def _rebuild(self) -> None:
        """Build the rectification maps anew, or forget them while the rig is not complete.

        The worker keeps using the former maps until the new ones are there.
        """
        surround = None
        self._rig_problem = ""
        if not self._assembler.problems():
            try:
                surround = SurroundDepthEstimator(self._assembler.rig(), self._estimator)
            except CvcDepthError as error:
                self._rig_problem = str(error)
        self._surround = surround

    def _work(self) -> None:
        while not self._mailbox.closed:
            surround_set = self._mailbox.get()
            if surround_set is None:
                continue
            try:
                self._handle(surround_set)
                self._set_problem = ""
            except CvcDepthError as error:
                self._refuse(str(error))
            except Exception as error:  # one bad set must not end the stream; its reason is reported
                if self._node.context.ok():
                    self._refuse(f"{type(error).__name__}: {error}")

    def _refuse(self, reason: str) -> None:
        self._counters["refused"] += 1
        self._set_problem = reason
        self._node.get_logger().error(f"set refused: {reason}", throttle_duration_sec=5.0)

    def _handle(self, surround_set: SurroundSet[ReceivedImage]) -> None:
        surround = self._surround
        if surround is None:
            self._counters["skipped: rig not complete"] += 1
        elif not self._outputs.wanted():
            self._counters["skipped: no subscriber"] += 1
        else:
            received = [image.received for image in surround_set.images.values()]
            self.latencies.record("wait for set", max(received) - min(received))
            self.latencies.record("wait for worker", time.monotonic() - max(received))
            images = [image.message for image in surround_set.images.values()]
            self._publish(surround_set, surround, estimate_set(images, surround, self.latencies))
            self.latencies.record("last image to published", time.monotonic() - max(received))
            self._counters["published"] += 1

    def _publish(
        self, surround_set: SurroundSet[ReceivedImage], surround: SurroundDepthEstimator, depth: SurroundDepth
    ) -> None:
        limits = read_parameters(self._node).cloud_limits
        frame_ids = {name: self._assembler.frame_id(name) or "" for name in surround.rig.names}
        with self.latencies.measure("publish"):
            self._outputs.publish(depth, surround.rig, surround_set.stamps_ns, frame_ids, limits)
        now = int(self._node.get_clock().now().nanoseconds)
        self.latencies.record("age at publish (ROS time)", (now - surround_set.stamp_ns) / 1e9)
