# SPDX-License-Identifier: Apache-2.0
"""Frames and the transforms between them, as `/tf_static` and `/tf` tell them (REP 105). Nothing here imports ROS.

Messages are taken by their attributes, so rclpy's objects and those of a recording both fit.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose, check_rigid, inverse, pose_from_quaternion, quaternion_from_rotation

# Below this angle (radians) between two rotations a straight line between their quaternions is exact in float64.
_SMALL_ANGLE = 1e-6
# Keyframes at 2 Hz pass, with jitter. A car in a bend (15 m/s, 0.3 rad/s) is then 0.2 m off the line between two poses.
_LONGEST_GAP = 0.6
# Noise of rounding, and no more.
_SAME_METRES, _SAME_DEGREES = 1e-3, 0.06


MAX_FRAMES = 5000
"""Of a vehicle's fixed transforms; vehicles have some dozens."""
_MAX_NAME = 255
_SHOWN = 20


def frame_name(frame_id: str) -> str:
    """Return the frame id without the leading slash that tf1 and some drivers write."""
    return frame_id.lstrip("/")


class Link(NamedTuple):
    """One transform."""

    stamp: int
    """ns."""
    parent: str
    child: str
    parent_T_child: Pose


class TransformTree:
    """The tree of fixed transforms of a vehicle."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}  # child -> (parent, parent_T_child)
        self.refused: dict[str, str] = {}
        """Frames that cannot be connected, and why: what `lookup` says of them."""

    @property
    def frames(self) -> list[str]:
        """All frames that are known, sorted."""
        return sorted(self._parents.keys() | {parent for parent, _ in self._parents.values()})

    def add(self, parent: str, child: str, parent_T_child: Pose) -> None:
        """Add a link, or renew the one that is there; `parent_T_child` [4, 4] in metres.

        Raises TransformError when the matrix is not rigid, the child has another parent already, or a loop would close.
        """
        parent, child = frame_name(parent), frame_name(child)
        if child not in self._parents and len(self._parents) >= MAX_FRAMES:
            raise TransformError(f"frame '{child}' is one too many: at most {MAX_FRAMES} are kept")
        check_rigid(parent_T_child, f"transform {parent} <- {child}")
        known, _ = self._parents.get(child, (parent, None))
        if known != parent:
            raise TransformError(f"frame '{child}' has two parents, '{known}' and '{parent}'")
        if child in self.ancestors(parent):
            raise TransformError(f"transform {parent} <- {child} closes a loop: {' <- '.join(self.ancestors(parent))}")
        self._parents[child] = parent, np.array(parent_T_child, dtype=np.float64)

    def add_message(self, message: Any, moment: str = "") -> None:
        """Add the transforms of a `tf2_msgs/TFMessage`.

        Where the `moment` is told, it is a recording's, and one that was told before with another pose is refused: all
        of the recording is to be seen with one tree. Without, it is renewed.

        Raises TransformError for the first that cannot be added, as in `add` or for a bad quaternion, when all others
        have been: who publishes all of a vehicle's transforms in one message must not lose them to a single one.
        """
        errors = []
        for link in message.transforms:
            try:
                _, parent, child, parent_T_child = link_of(link)
                if moment:
                    self._refuse_if_moved(parent, child, parent_T_child, moment)
                self.add(parent, child, parent_T_child)
            except TransformError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _refuse_if_moved(self, parent: str, child: str, parent_T_child: Pose, moment: str) -> None:
        known, known_T_child = self._parents.get(child, ("", parent_T_child))
        if known != parent:
            return
        change = inverse(known_T_child) @ parent_T_child
        metres = float(np.linalg.norm(change[:3, 3]))
        sine = float(np.linalg.norm(quaternion_from_rotation(change[:3, :3])[:3]))
        degrees = np.degrees(2 * np.arcsin(min(1.0, sine)))
        if metres > _SAME_METRES or degrees > _SAME_DEGREES:
            self.refused[child] = (
                f"{parent} <- {child} moves {moment} by {metres:.3f} m and {degrees:.2f} degrees; take the parts "
                "before and after that as two recordings, or give the poses in a rig file"
            )

    def lookup(self, target_frame: str, source_frame: str) -> Pose:
        """Return target_T_source [4, 4], which takes points of the source frame to the target frame.

        Raises TransformError, naming the frame that is missing and those that are known, when nothing connects them.
        """
        target, source = frame_name(target_frame), frame_name(source_frame)
        known = self._shown_frames()
        for frame in (target, source):
            if frame in self.refused:
                raise TransformError(f"no transform {target} <- {source}: {self.refused[frame]}")
        for frame in (target, source):
            if frame not in self.frames:
                raise TransformError(
                    f"no transform {target} <- {source}: frame '{frame}' is unknown; known are {known}"
                )
        target_root, root_T_target = self._to_root(target)
        source_root, root_T_source = self._to_root(source)
        if target_root != source_root:
            raise TransformError(
                f"no transform {target} <- {source}: '{target}' hangs from '{target_root}', '{source}' from "
                f"'{source_root}', and nothing connects the two; known are {known}"
            )
        for frame in self._between(target, source):
            if frame in self.refused:
                raise TransformError(f"no transform {target} <- {source}: {self.refused[frame]}")
        found = inverse(root_T_target) @ root_T_source
        if not np.isfinite(found).all():
            raise TransformError(f"no transform {target} <- {source}: its links lead farther than a number can say")
        return found

    def _between(self, target: str, source: str) -> list[str]:
        """Return the frames whose links lead from one frame to the other."""
        ends = self.ancestors(target), self.ancestors(source)
        return [frame for chain in ends for frame in chain if frame not in ends[0] or frame not in ends[1]]

    def ancestors(self, frame: str) -> list[str]:
        """Return the frame itself, its parent, and so on up to the root."""
        chain = [frame_name(frame)]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]][0])
        return chain

    def _shown_frames(self) -> str:
        frames = self.frames
        more = f" and {len(frames) - _SHOWN} more" if len(frames) > _SHOWN else ""
        return f"{frames[:_SHOWN]}{more}"

    def _to_root(self, frame: str) -> tuple[str, Pose]:
        *links, root = self.ancestors(frame)
        root_T_frame = np.eye(4)
        for child in links:
            root_T_frame = self._parents[child][1] @ root_T_frame
        return root, root_T_frame


class PoseTrack:
    """One moving link (odom to base_link, say) over time."""

    def __init__(self, parent: str, child: str, longest_gap: float = _LONGEST_GAP) -> None:
        """Between poses that are more than `longest_gap` seconds apart nothing is interpolated."""
        self.parent, self.child = frame_name(parent), frame_name(child)
        self._longest_gap = longest_gap
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def span(self) -> tuple[int, int]:
        """First and last stamp, ns. Raises TransformError when nothing was added."""
        if not self._stamps:
            raise TransformError(f"no transform {self.parent} <- {self.child} at any time")
        return self._stamps[0], self._stamps[-1]

    def add(self, stamp: int, parent_T_child: Pose) -> None:
        """Add the pose [4, 4] at a stamp (ns), in any order; a stamp that is there already is renewed."""
        check_rigid(parent_T_child, f"transform {self.parent} <- {self.child} at {stamp} ns")
        index = bisect_left(self._stamps, stamp)
        if index < len(self) and self._stamps[index] == stamp:
            self._poses[index] = parent_T_child
            return
        self._stamps.insert(index, stamp)
        self._poses.insert(index, parent_T_child)

    def add_message(self, message: Any) -> None:
        """Add the transforms of a `tf2_msgs/TFMessage` that are of this link; the others are passed over."""
        for transform in message.transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            if (parent, child) == (self.parent, self.child):
                link = link_of(transform)
                self.add(link.stamp, link.parent_T_child)

    def lookup(self, stamp: int) -> Pose:
        """Return parent_T_child [4, 4] at a stamp (ns): translation interpolated linearly, rotation by slerp.

        Raises TransformError outside of the span, for nothing is extrapolated, and in a gap.
        """
        first, last = self.span
        if not first <= stamp <= last:
            raise TransformError(
                f"no transform {self.parent} <- {self.child} at {stamp} ns: it is known from {first} to {last} ns"
            )
        index = bisect_left(self._stamps, stamp)
        if self._stamps[index] == stamp:
            return np.array(self._poses[index])
        before, after = self._stamps[index - 1], self._stamps[index]
        if after - before > self._longest_gap * 1e9:
            raise TransformError(
                f"no transform {self.parent} <- {self.child} at {stamp} ns: it is known at {before} and {after} ns, "
                f"{(after - before) / 1e9:.3f} s apart, more than {self._longest_gap:g} s"
            )
        fraction = (stamp - before) / (after - before)
        return _interpolated(self._poses[index - 1], self._poses[index], fraction)

    def forget_before(self, stamp: int) -> None:
        """Drop the poses that no lookup at or after `stamp` (ns) needs."""
        needed = max(bisect_right(self._stamps, stamp) - 1, 0)
        del self._stamps[:needed], self._poses[:needed]


def links_of(message: Any) -> Iterator[Link]:
    """Give every transform of a TFMessage; TransformError as `link_of`."""
    return map(link_of, message.transforms)


def link_of(transform: Any) -> Link:
    """Take a TransformStamped apart; TransformError for a bad quaternion or an endless name."""
    stamp = transform.header.stamp.sec * 10**9 + transform.header.stamp.nanosec
    parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
    if max(len(parent), len(child)) > _MAX_NAME:
        raise TransformError(
            f"frame '{max(parent, child, key=len):.40}...' has a name of more than {_MAX_NAME} letters"
        )
    t, q = transform.transform.translation, transform.transform.rotation
    pose = pose_from_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w), f"transform {parent} <- {child}")
    return Link(stamp, parent, child, pose)


def _interpolated(start: Pose, end: Pose, fraction: float) -> Pose:
    translation = (1 - fraction) * start[:3, 3] + fraction * end[:3, 3]
    rotation = _slerp(quaternion_from_rotation(start[:3, :3]), quaternion_from_rotation(end[:3, :3]), fraction)
    return pose_from_quaternion(_floats(translation), _floats(rotation))


def _slerp(start: NDArray[np.float64], end: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Return the unit quaternion on the shorter great arc between two, at constant angular speed (Shoemake 1985)."""
    end = end if start @ end >= 0 else -end
    angle = 2 * np.arctan2(np.linalg.norm(end - start), np.linalg.norm(end + start))
    if angle < _SMALL_ANGLE:
        return start + fraction * (end - start)
    blended: NDArray[np.float64] = (np.sin((1 - fraction) * angle) * start + np.sin(fraction * angle) * end) / np.sin(
        angle
    )
    return blended


def _floats(values: NDArray[np.float64]) -> Sequence[float]:
    return [float(value) for value in values]
