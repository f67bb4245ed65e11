# SPDX-License-Identifier: Apache-2.0
"""One active period of the node: its topics connected to the pipeline, and the state of each camera."""

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.overlap_monitor import OverlapMonitor
from cvcdepth_core.stamps import exposure_times
from cvcdepth_ros.live.camera_states import CameraCondition, CameraState, CameraWatch, Trouble, condition
from cvcdepth_ros.live.mailbox import Mailbox
from cvcdepth_ros.live.picture_preparation import CameraImage
from cvcdepth_ros.live.pipeline import SurroundPipeline
from cvcdepth_ros.live.set_progress import NodeClock, SetProgress
from cvcdepth_ros.live.stamp_ages import StampAges
from cvcdepth_ros.live.transport_loss import TransportLoss
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.node.diagnostics import (
    camera_status,
    deskew_status,
    ground_plane_status,
    ground_problem,
    ground_status,
    inference_status,
    model_status,
    overlap_status,
    refinement_status,
    synchronisation_status,
)
from cvcdepth_ros.node.motion_input import MotionInput
from cvcdepth_ros.node.parameters import read_parameters, unknown_qos_overrides
from cvcdepth_ros.node.publishers import SurroundOutputs
from cvcdepth_ros.node.rig_transforms import RigTransforms
from cvcdepth_ros.node.subscriptions import CameraInputs, StaticTransformInput
from cvcdepth_ros.settings import NodeParameters
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.output_messages import OutputLimits
from cvcdepth_ros.surround_sets.refinement import RefinementStage
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet
from cvcdepth_ros.surround_sets.synchronizer import SurroundSynchronizer
from cvcdepth_ros.surround_sets.trace_file import TraceFile


class SurroundSession:
    """Subscriptions, pipeline and publishers of one active period.

    Callbacks run on the executor's thread and only pass images on; everything heavy is the pipeline's.
    """

    def __init__(
        self, node: Node, assembler: RigAssembler, estimator: DepthEstimator, parameters: NodeParameters
    ) -> None:
        """Subscribe, advertise and start the threads; ConfigError names a parameter that does not fit the rig.

        `assembler` has the rig's layout, and may have collected some of what that leaves open.
        """
        self._node = node
        self._estimator = estimator
        self._assembler, layout = assembler, assembler.layout
        self._places: dict[str, bytes] = {}
        self._synchroniser: SurroundSynchronizer[CameraImage] = SurroundSynchronizer.from_layout(
            layout, parameters.tolerance, parameters.queue_size, parameters.min_cameras
        )
        self._mailbox: Mailbox[CameraImage] = Mailbox(parameters.max_age or None, self._ros_time)
        self._watches = {name: CameraWatch(parameters.stale_after, parameters.frozen_after) for name in layout.names}
        self._overlaps: OverlapMonitor | None = None
        self._monitored_rig: Rig | None = None
        self._max_image_mb = parameters.max_image_mb
        self._offsets_ns = {camera.name: camera.stamp_offset_ns for camera in layout.cameras}
        self._loss = TransportLoss()
        self.transport_problem = ""
        """Why images do not arrive that were sent; empty while they do."""
        self._progress = SetProgress(self._synchroniser.required, parameters.tolerance, parameters.max_age)
        self._is_finished = False
        self._needs_confidence = parameters.needs_confidence
        self._deskews = parameters.cloud_deskew
        with ExitStack() as opened:
            trace = None
            if parameters.trace:
                trace = opened.enter_context(closing(TraceFile(Path(parameters.trace).expanduser())))
            self.latencies = StageLatencies(trace)
            self._ages = StampAges(self.latencies, self._ros_time)
            if any(camera.base_T_camera is None for camera in layout.cameras):
                transforms = StaticTransformInput(node, assembler.transforms, self._on_transforms)
                opened.enter_context(closing(transforms))
            self._transforms = self._rig_transforms(opened) if parameters.publish_tf else None
            outputs = SurroundOutputs(node, layout.names, parameters, self.latencies)
            self._outputs = opened.enter_context(closing(outputs))
            motion = MotionInput(node, layout.base_frame, parameters.odometry_topic)
            self._motion = opened.enter_context(closing(motion))
            self._refinement = RefinementStage(
                parameters,
                motion.poses.poses_at,
                self._wants_confidence,
                self.latencies,
                parameters.publish_odometry,
                lambda: bool(motion.poses.topic),
                wants_poses=parameters.needs_poses,
            )
            self._pipeline = SurroundPipeline(
                estimator,
                self._synchroniser,
                self._mailbox,
                self._watches,
                self._outputs.wanted,
                self._publish,
                self._watch_overlaps if parameters.overlap_monitor else lambda _: None,
                self.latencies,
                self._refinement,
            )
            opened.callback(self._close_pipeline)
            inputs = CameraInputs(node, layout, parameters.reliable, self._on_image, self._on_camera_info)
            self._inputs = opened.enter_context(closing(inputs))
            self._rebuild()
            self._opened = opened.pop_all()
        for line in unknown_qos_overrides(node, self._inputs.image_topics):
            node.get_logger().warning(line)
        self._warn_of_unstated_ground()

    def _rig_transforms(self, opened: ExitStack) -> RigTransforms | None:
        """Return what publishes poses that only the rig has; None where there are none, or without tf2_msgs."""
        if all(camera.base_T_camera is None and not camera.is_turned for camera in self._assembler.layout.cameras):
            return None
        try:
            return opened.enter_context(closing(RigTransforms(self._node, self._assembler)))
        except ImportError:
            self._node.get_logger().info("the rig file's poses are not on /tf_static: tf2_msgs is not installed")
            return None

    def _wants_confidence(self) -> bool:
        return self._needs_confidence or self._outputs.wants_confidence()

    def poll(self) -> None:
        """Subscribe image topics that have appeared, and follow how far the sets come. To be called regularly."""
        self._inputs.connect()
        if self._refinement.needs_motion:
            self._motion.connect()
        if self._transforms is not None:
            self._transforms.poll()
        counts = {**asdict(self._mailbox.statistics()), **self._pipeline.counters}
        self._progress.update(self._synchroniser.statistics(), counts)
        self.transport_problem = self._loss.update(self._inputs.lost)

    def set_model(self, estimator: DepthEstimator) -> None:
        """Use another network from the next set on; EngineError when it cannot run."""
        self._pipeline.set_model(estimator)
        self._estimator = estimator
        self._warn_of_unstated_ground()
        self._monitored_rig = None  # what was usual for the former network need not be for this one

    def resume_listening(self) -> None:
        """Count the cameras' silence from now on: the executor was busy, and took no image until now."""
        for watch in self._watches.values():
            watch.resume_listening()

    def close(self) -> bool:
        """Stop everything; False when a thread is still busy with its last set a second later."""
        self._opened.close()
        return self._is_finished

    def conditions(self) -> dict[str, CameraCondition]:
        """Return each camera's state and the reason for it."""
        troubles = {name: self._setup_troubles(name) for name in self._watches}
        for name, found in self._inputs.troubles().items():
            troubles[name] += [*found, *self._watches[name].troubles()]
        statistics = self._synchroniser.statistics().cameras
        # Cameras that are missing leave all others unmatched when those are too few for a set.
        are_too_few = sum(not found for found in troubles.values()) < self._synchroniser.required
        for name, watch in self._watches.items():
            troubles[name] += watch.unmatched(statistics[name].matched, bool(troubles[name]) or are_too_few)
        return {name: condition(name, found) for name, found in troubles.items()}

    @property
    def is_matching(self) -> bool:
        """Whether sets come, or no images do."""
        return self._progress.is_matching

    @property
    def has_idle_sets(self) -> bool:
        """Whether sets came and nobody has subscribed to what would be made of them."""
        counters = self._pipeline.counters
        return bool(counters["skipped: no subscriber"]) and not counters["published"]

    def standstill(self, node_clock: NodeClock) -> str:
        """Return why images come but no set gets through, and the remedy; empty while they do."""
        found = self.conditions().items()
        reasons = {n: c.text for n, c in found if c.state not in (CameraState.OK, CameraState.UNMATCHED)}
        return self._progress.problem(reasons, node_clock, self._mailbox.stale_age)

    def overlap_findings(self) -> str:
        """Return what the comparison of neighbouring cameras has found; empty where all is well."""
        return "; ".join(map(str, self._overlaps.findings())) if self._overlaps else ""

    def odometry_problem(self) -> str:
        """Return why recorded motion is not used, or what is odd about it; empty where it fits."""
        last = self._refinement.last
        return (last.refined.odometry_problem if last else "") or self._motion.poses.problem

    @property
    def unknown_latencies(self) -> list[str]:
        """The stages whose latencies cannot be known, since images are not stamped in the node's time."""
        return self._ages.unknown

    @property
    def problem(self) -> str:
        """The reason why the last set was refused; empty when it was not."""
        return self._pipeline.problem

    @property
    def refused(self) -> int:
        """Number of sets that were refused so far."""
        return self._pipeline.counters["refused"]

    def diagnostics(self, node_clock: NodeClock) -> list[DiagnosticStatus]:
        """Return the statuses of cameras, synchronisation, inference, model and overlaps."""
        statistics, mailbox = self._synchroniser.statistics(), self._mailbox.statistics()
        cameras = [
            camera_status(name, found, statistics.cameras[name], self._watches[name], self._inputs.lost[name])
            for name, found in self.conditions().items()
        ]
        return [
            *cameras,
            synchronisation_status(statistics, mailbox, self._pipeline.counters, self.standstill(node_clock)),
            inference_status(
                self.latencies.summaries(), mailbox, self.problem, self._estimator.model_id, self.unknown_latencies
            ),
            model_status(self._estimator),
            *([ground_status(self._assembler.layout)] if self._estimator.spec.is_told_its_rig else []),
            *([overlap_status(self._overlaps)] if self._overlaps else []),
            *([ground_plane_status(self._outputs.ground)] if self._outputs.ground else []),
            *([deskew_status(self._outputs.deskewed)] if self._deskews else []),
            *([refinement_status(self._refinement, self._motion.poses)] if self._refinement.is_active else []),
        ]

    def _warn_of_unstated_ground(self) -> None:
        problem = ground_problem(self._assembler.layout)
        if problem and self._estimator.spec.is_told_its_rig:
            self._node.get_logger().warning(problem)

    def _setup_troubles(self, camera: str) -> list[Trouble]:
        """Return what the camera still lacks before its images can be used."""
        assembler, states = self._assembler, CameraState
        reasons = [
            (states.REJECTED, assembler.refusal(camera)),
            (states.REJECTED, self._pipeline.rig_problems.get(camera)),
            (states.WAITING_FOR_CAMERA_INFO, assembler.calibration_problem(camera)),
            (states.WAITING_FOR_TRANSFORM, assembler.transform_problem(camera)),
        ]
        return [(state, reason) for state, reason in reasons if reason]

    def _close_pipeline(self) -> None:
        self._is_finished = self._pipeline.close()

    def _on_image(self, cameras: Sequence[str], message: Any) -> None:
        taken = exposure_times(stamp_ns(message), self._offsets_ns[cameras[0]])
        self._ages.record("receive (ROS time)", cameras[0], taken)
        megabytes = len(message.data) / 1e6
        if megabytes > self._max_image_mb:
            too_large = f"image of {megabytes:.1f} MB, more than max_image_mb ({self._max_image_mb:g})"
            for camera in cameras:
                self._watches[camera].used(too_large)
            return
        self._pipeline.add(cameras, message)

    def _on_camera_info(self, cameras: Sequence[str], message: Any) -> None:
        if True in [self._assembler.add_camera_info(camera, message) for camera in cameras]:
            self._rebuild()

    def _on_transforms(self) -> None:
        if self._complete_places() != self._places:
            self._rebuild()

    def _complete_places(self) -> dict[str, bytes]:
        """Return where each complete camera is mounted, to be compared."""
        lacking = self._assembler.problems()
        return {name: self._assembler.pose(name).tobytes() for name in self._watches if name not in lacking}

    def _rebuild(self) -> None:
        """Have the rectification maps built anew, or forgotten while too few cameras are complete."""
        self._places = self._complete_places()
        enough = len(self._places) >= self._synchroniser.required
        try:
            self._pipeline.set_rig(self._assembler.rig(self._places) if enough else None)
        except CvcDepthError as error:
            self._pipeline.set_rig(None)
            self._node.get_logger().error(str(error))

    def _publish(self, published: EstimatedSet[CameraImage]) -> None:
        frame_ids = {name: self._assembler.view_frame_id(name) or "" for name in published.rig.names}
        parameters = read_parameters(self._node)
        self._needs_confidence = parameters.needs_confidence
        self._outputs.publish(published, frame_ids, OutputLimits.of(parameters))
        newest = max(published.surround_set.times_ns.values())
        self._ages.record("age of newest image at publish (ROS time)", "", newest)

    def _watch_overlaps(self, published: EstimatedSet[CameraImage]) -> None:
        if self._overlaps is None or self._monitored_rig is not published.rig:
            self._overlaps, self._monitored_rig = OverlapMonitor(published.rig), published.rig
        with self.latencies.measure("overlap monitor"):
            self._overlaps.update(published.result, published.surround_set.stamp_ns)

    def _ros_time(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)
