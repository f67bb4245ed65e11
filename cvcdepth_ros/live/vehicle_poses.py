# SPDX-License-Identifier: Apache-2.0
"""The vehicle's motion as it is received, for whoever needs its pose at exposures a moment ago. No ROS here."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.messages.vehicle_motion import VehicleMotion, motion_link

_KEPT_NS = 2 * NANOSECONDS
_PATIENCE = 0.1  # seconds that a pose may come later than the depth of its set
_JUMP_NS = NANOSECONDS  # by which stamps go back when a recording begins again


class VehiclePoses:
    """Collects poses on one thread and gives those between them on another."""

    def __init__(self, base_frame: str, fixed: TransformTree) -> None:
        """Know of no motion yet; `fixed` are the vehicle's fixed transforms, as far as they have been received."""
        self._base_frame, self._fixed = base_frame, fixed
        self._changed = threading.Condition()
        self._motion: VehicleMotion | None = None
        self._newest: int | None = None
        self.problem = ""
        """Why the last message cannot be used; empty when it can."""

    @property
    def topic(self) -> str:
        """Where the motion comes from; empty while there is none."""
        return self._motion.topic if self._motion else ""

    def add(self, topic: str, message: Any) -> None:
        """Take a `tf2_msgs/TFMessage` or `nav_msgs/Odometry` in; those that do not tell of the vehicle say nothing."""
        with self._changed:
            try:
                self._add(topic, message)
                self.problem = ""
            except TransformError as error:
                self.problem = str(error)
            self._changed.notify_all()

    def poses_at(self, times_ns: Mapping[str, int]) -> dict[str, Pose] | None:
        """Return world_T_base [4, 4] at each exposure (ns), waited for a little; None where not all are known."""
        last = max(times_ns.values())
        with self._changed:
            if self._motion is None:
                return None
            is_silent = last - (self._newest or 0) > _KEPT_NS
            self._changed.wait_for(lambda: (self._newest or 0) >= last, 0 if is_silent else _PATIENCE)
            try:
                poses = {name: self._motion.base_pose(time) for name, time in times_ns.items()}
            except TransformError:
                return None
            self._motion.forget_before(min(times_ns.values()) - _KEPT_NS)
            return poses

    def _add(self, topic: str, message: Any) -> None:
        stamps = [stamp_ns(part) for part in getattr(message, "transforms", [message])]
        if self._newest is not None and stamps and max(stamps) < self._newest - _JUMP_NS:
            self._motion = self._newest = None
        if self._motion is None:
            link = motion_link(topic, message, self._base_frame, self._fixed)
            self._motion = None if link is None else VehicleMotion(link)
        if self._motion is not None and self._motion.topic == topic:
            self._motion.add(message)
            self._newest = self._motion.newest_ns
