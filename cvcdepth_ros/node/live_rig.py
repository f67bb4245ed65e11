# SPDX-License-Identifier: Apache-2.0
"""`rig:=auto`: find the cameras of a running system, their calibrations and their poses."""

import time
from collections.abc import Collection
from functools import partial

from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_ros.messages.camera_discovery import RECORDED_IMAGE_TYPES, discover_cameras
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.node.subscriptions import StaticTransformInput, topic_types

_SETTLING_SECONDS, _SETTLING_SECONDS_ALONE = 3.0, 10.0
_SHOWN = 3


class LiveRigDiscovery:
    """Watches the graph until its cameras stay the same for three seconds and each is calibrated and has a pose.

    A single camera is waited with for ten seconds.
    """

    def __init__(self, node: Node, base_frame: str, min_cameras: int) -> None:
        """Start listening. ConfigError where tf2_msgs is not installed: then nothing tells the cameras' poses."""
        self._node = node
        self._base_frame = base_frame
        self._least = max(1, min_cameras)
        self._entries: tuple[CameraEntry, ...] = ()
        self._unpaired: list[str] = []
        self._assembler: RigAssembler | None = None
        self._subscriptions: list[Subscription] = []
        self._tree = TransformTree()
        self._refusal = ""
        self._transforms = StaticTransformInput(node, self._tree)
        self._changed = time.monotonic()

    def poll(self) -> RigAssembler | None:
        """Return the rig's assembler, cameras in their order, once the graph has all of it; None before.

        Its layout leaves calibrations and poses open, so that they can change later.
        """
        self._watch_graph()
        # Drivers start one after the other: a single camera mostly has others still to come.
        patience = _SETTLING_SECONDS if len(self._entries) > 1 else _SETTLING_SECONDS_ALONE
        settled = time.monotonic() - self._changed > patience
        if not settled or self._assembler is None or self._assembler.problems():
            return None
        try:
            self._assembler.split_wide_lenses()
            self._assembler.order_around_vehicle()
        except CvcDepthError as error:  # cameras that are each complete but together no rig
            self.refuse(str(error))
            return None
        return self._assembler

    def refuse(self, reason: str) -> None:
        """Wait for another rig, since the one that was found cannot be used; `reason` is told until then."""
        self._refusal, self._changed = reason, time.monotonic()

    def problem(self) -> str:
        """Return what is still missing, and the remedy."""
        if len(self._entries) < self._least:
            names = ", ".join(entry.name for entry in self._entries) or "none"
            cameras = "1 camera" if self._least == 1 else f"{self._least} cameras"
            want = f"at least {cameras} with image and camera_info topics"
            return f"waiting for {want}, found {names}{self._hint()}"
        problems = self._assembler.problems() if self._assembler else {}
        if not problems:
            return self._refusal or "waiting for the set of cameras to settle"
        first, *others = problems.values()
        more = f" (and so for {len(others)} more of {len(self._entries)} cameras)" if others else ""
        is_pose = self._assembler is not None and self._assembler.calibration_problem(next(iter(problems))) is None
        remedy = f"; publish it on /tf_static; the parameter base_frame is {self._base_frame}" if is_pose else ""
        return f"{first}{more}{remedy}"

    def _hint(self) -> str:
        """Return where cameras may be that were not found."""
        if self._unpaired:
            more = f" and {len(self._unpaired) - _SHOWN} more" if len(self._unpaired) > _SHOWN else ""
            return f"; without camera_info beside them: {', '.join(self._unpaired[:_SHOWN])}{more}"
        return "; are the drivers running, in this ROS_DOMAIN_ID?" if not self._entries else ""

    def close(self) -> None:
        """Drop all subscriptions."""
        self._transforms.close()
        self._drop_camera_infos()

    def _watch_graph(self) -> None:
        # A node's own outputs look like cameras too.
        own = f"{self._node.get_fully_qualified_name()}/"
        types = {topic: names[0] for topic, names in topic_types(self._node).items() if not topic.startswith(own)}
        entries = tuple(discover_cameras(types))
        images = {topic for topic, name in types.items() if name in RECORDED_IMAGE_TYPES}
        self._unpaired = sorted(topic for topic in images if not _has_info(topic, types))
        if entries == self._entries:
            return
        self._entries, self._changed = entries, time.monotonic()
        self._drop_camera_infos()
        self._assembler = None
        if len(entries) >= self._least:
            self._assembler = RigAssembler(RigLayout(base_frame=self._base_frame, cameras=entries), self._tree)
            self._subscriptions = [self._subscribe(entry, self._assembler) for entry in entries]

    def _subscribe(self, entry: CameraEntry, assembler: RigAssembler) -> Subscription:
        callback = partial(assembler.add_camera_info_on, entry.camera_info_topic)
        return self._node.create_subscription(
            CameraInfo, entry.camera_info_topic, lambda message: callback(message), qos_profile_sensor_data
        )

    def _drop_camera_infos(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []


def _has_info(image_topic: str, topics: Collection[str]) -> bool:
    """Whether a camera_info stands beside the image topic, or beside the one that it is a transport of."""
    parts = image_topic.split("/")
    return any("/".join([*parts[:-depth], "camera_info"]) in topics for depth in (1, 2))
