# SPDX-License-Identifier: Apache-2.0
"""The output topics and their messages, the same whether a node publishes them or a recording stores them."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from cvcdepth_core.obstacles.ground import GroundPlane
from cvcdepth_core.obstacles.persistence import Persistence
from cvcdepth_core.obstacles.scan import Scan, ScanLimits, scan_of
from cvcdepth_core.obstacles.separation import ObstacleLimits, SeparatedCloud, separate
from cvcdepth_core.pointcloud import CameraMoments, Cloud, CloudLimits, banded, merged_cloud, organised_cloud, thinned
from cvcdepth_core.refinement.drive import VisualMotion
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.surround_depth import SkyChoice, SurroundDepth
from cvcdepth_ros.messages.camera_discovery import CAMERA_INFO_TYPE, IMAGE_TYPE
from cvcdepth_ros.messages.conversion import Covariances, MessageFactory
from cvcdepth_ros.messages.point_clouds import POINT_CLOUD_TYPE
from cvcdepth_ros.messages.vehicle_motion import ODOMETRY_TYPE
from cvcdepth_ros.settings import OutputSettings
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet

_VISUAL_WORLD = "visual_odom"

STRING_TYPE = "std_msgs/msg/String"
SCAN_TYPE = "sensor_msgs/msg/LaserScan"

MERGED_CLOUD = "points"
MERGED_CAMERAS = "points/cameras"
OBSTACLES, GROUND, SCAN = "obstacles", "ground", "scan"
DEPTH, DEPTH_INFO = "depth/image_rect", "depth/camera_info"
CONFIDENCE = "depth/confidence"
ODOMETRY = "odometry"
PICTURE, PICTURE_INFO, CLOUD = "image_rect", "camera_info", "points"
_CAMERA_TYPES = {
    DEPTH: IMAGE_TYPE,
    DEPTH_INFO: CAMERA_INFO_TYPE,
    CONFIDENCE: IMAGE_TYPE,
    PICTURE: IMAGE_TYPE,
    PICTURE_INFO: CAMERA_INFO_TYPE,
    CLOUD: POINT_CLOUD_TYPE,
}
_MERGED_TYPES = {
    MERGED_CLOUD: POINT_CLOUD_TYPE,
    MERGED_CAMERAS: STRING_TYPE,
    OBSTACLES: POINT_CLOUD_TYPE,
    GROUND: POINT_CLOUD_TYPE,
    SCAN: SCAN_TYPE,
}


class OutputLimits(NamedTuple):
    """Which points clouds keep, and what an obstacle and a scan are."""

    cloud: CloudLimits = CloudLimits()
    obstacles: ObstacleLimits = ObstacleLimits()
    scan: ScanLimits = ScanLimits()
    deskew: bool = False
    """Whether points are moved to the cloud's moment, where the vehicle's motion is known."""
    persistence: int = 0
    """How many earlier sets must have shown a point too."""
    has_times: bool = False
    """Whether points tell by how much later than the cloud's moment they were seen."""

    @classmethod
    def of(cls, settings: OutputSettings) -> "OutputLimits":
        """Return those of the settings."""
        return cls(
            settings.cloud_limits,
            settings.obstacle_limits,
            settings.scan_limits,
            settings.cloud_deskew,
            settings.cloud_persistence,
            settings.cloud_times,
        )


class OutputMessage(NamedTuple):
    """One message of a set."""

    topic: str
    """Below the node's name."""
    camera: str
    """The camera whose stamp it carries: its own, or the set's anchor for what belongs to the merged cloud."""
    message: Any


def output_types(cameras: Sequence[str], has_odometry: bool = False) -> dict[str, str]:
    """Return every output topic, below the node's name, with its message type."""
    odometry = {ODOMETRY: ODOMETRY_TYPE} if has_odometry else {}
    per_camera = {f"{camera}/{part}": type_ for camera in cameras for part, type_ in _CAMERA_TYPES.items()}
    return {**per_camera, **_MERGED_TYPES, **odometry}


def camera_topics(camera: str) -> list[str]:
    """Return the output topics, below the node's name, for which this camera's depth is needed.

    What a merged cloud contains is known when it could be made.
    """
    return [*(f"{camera}/{part}" for part in _CAMERA_TYPES), *_MERGED_TYPES, ODOMETRY]


class MergedProducts:
    """What is made of all cameras of a set together; each part is made once, when it is asked for."""

    def __init__(self, estimated: EstimatedSet[Any], limits: OutputLimits, persistence: Persistence) -> None:
        """Make nothing yet; `persistence` remembers the sets before this one."""
        self._estimated, self._limits, self._persistence = estimated, limits, persistence

    @cached_property
    def points(self) -> Cloud:
        """The merged cloud [M, 4] inside its limits, base frame."""
        limits = self._limits.cloud
        inside = banded(self._whole, limits)
        return thinned(inside, limits.voxel) if limits.voxel else inside

    @cached_property
    def separated(self) -> SeparatedCloud:
        """Ground and obstacles."""
        return separate(self._whole, self._estimated.rig.ground_z, self._limits.obstacles)

    @cached_property
    def _whole(self) -> Cloud:
        estimated = self._estimated
        whole = merged_cloud(estimated.result, estimated.rig, self._limits.cloud.whole, self._moments)
        if not self._limits.persistence:
            return whole
        poses, surround_set = estimated.world_T_base, estimated.surround_set
        place = None if poses is None else poses[self._anchor]
        return self._persistence.filtered(whole, place, surround_set.time_ns, self._limits.persistence)

    @property
    def is_deskewed(self) -> bool:
        """Whether points are moved to the cloud's moment."""
        return self._limits.deskew and self._estimated.world_T_base is not None

    @property
    def _anchor(self) -> int:
        """Whose moment is meant: the anchor's; while the rig is incomplete and lacks it, that of its first camera."""
        names, anchor = self._estimated.rig.names, self._estimated.surround_set.anchor
        return names.index(anchor) if anchor in names else int(np.argmax(self._estimated.result.present))

    @property
    def _moments(self) -> CameraMoments:
        estimated, rig = self._estimated, self._estimated.rig
        surround_set, poses = estimated.surround_set, estimated.world_T_base
        moments = CameraMoments.unmoved(rig)
        if self._limits.deskew and poses is not None:
            moments = CameraMoments.moved(rig, poses, self._anchor)
        if not self._limits.has_times:
            return moments
        times = np.array([surround_set.times_ns.get(name, surround_set.time_ns) for name in rig.names], np.int64)
        return moments._replace(seconds=(times - surround_set.time_ns) / NANOSECONDS)


class SurroundMessages:
    """Builds the messages of surround sets, with the message classes of one library."""

    def __init__(
        self,
        factory: MessageFactory,
        depth_encoding: str,
        depth_min_confidence: float = 0.0,
        sky: SkyChoice = "keep",
    ) -> None:
        """Depth images are unknown where confidence is below `depth_min_confidence`; for `sky` see `shown_depth`."""
        self._factory = factory
        self._sky: SkyChoice = sky
        self._encoding = depth_encoding
        self._least = depth_min_confidence
        self._persistence = Persistence()
        self.deskewed: bool | None = None
        """Whether the points of the last merged cloud were moved to its moment; None before any."""
        self.ground: GroundPlane | None = None
        """Where the ground was in the last set whose obstacles were asked for; None before any."""

    def of_set(
        self,
        estimated: EstimatedSet[Any],
        frame_ids: Mapping[str, str],
        limits: OutputLimits,
        wanted: Callable[[str], object],
    ) -> Iterator[OutputMessage]:
        """Build, one after the other, the messages of the topics that are `wanted`, for the cameras that are there.

        What belongs to one camera carries that camera's own stamp (ns) and optical frame, so that it matches the input
        image exactly; the merged cloud carries the stamp of the set's anchor and the base frame.
        """
        surround_set, rig, result = estimated.surround_set, estimated.rig, estimated.result
        for index, camera in enumerate(rig.names):
            if result.present[index]:
                stamp = surround_set.stamps_ns[camera]
                builders = self._camera_messages(result, index, stamp, frame_ids[camera], limits.cloud.min_confidence)
                for part, build in builders.items():
                    if wanted(f"{camera}/{part}"):
                        yield OutputMessage(f"{camera}/{part}", camera, build())
        for topic, build in self._merged_messages(estimated, limits).items():
            if wanted(topic):
                yield OutputMessage(topic, surround_set.anchor, build())
        if estimated.visual is not None and wanted(ODOMETRY):
            yield OutputMessage(ODOMETRY, surround_set.anchor, self._odometry(estimated.visual, rig.base_frame))

    def _depth_image(self, stamp: int, frame_id: str, result: SurroundDepth, index: int) -> Any:
        depth = result.shown_depth(index, self._sky, self._least)
        return self._factory.depth_image(stamp, frame_id, depth, self._encoding)

    def _odometry(self, visual: VisualMotion, base_frame: str) -> Any:
        """Return the motion that the pictures tell; its world is another one after every gap."""
        errors = Covariances(visual.covariance, visual.aligned.covariance)
        return self._factory.odometry(
            visual.time_ns, _VISUAL_WORLD, base_frame, visual.world_T_base, visual.aligned.twist, errors
        )

    def _merged_messages(self, estimated: EstimatedSet[Any], limits: OutputLimits) -> dict[str, Callable[[], Any]]:
        """Return how to build each of the messages about all cameras together."""
        stamp, rig = estimated.surround_set.stamp_ns, estimated.rig
        contained = [name for name, present in zip(rig.names, estimated.result.present, strict=True) if present]
        description = {"stamp": stamp, "frame_id": rig.base_frame, "cameras": contained}
        make, frame, merged = self._factory, rig.base_frame, MergedProducts(estimated, limits, self._persistence)
        return {
            MERGED_CLOUD: lambda: make.point_cloud(stamp, frame, self._noted(merged).points),
            MERGED_CAMERAS: lambda: make.string(json.dumps(description)),
            OBSTACLES: lambda: make.point_cloud(stamp, frame, self._separated(merged).obstacles),
            GROUND: lambda: make.point_cloud(stamp, frame, self._separated(merged).ground),
            SCAN: lambda: make.laser_scan(stamp, frame, self._scan(merged, limits)),
        }

    def _noted(self, merged: MergedProducts) -> MergedProducts:
        self.deskewed = merged.is_deskewed
        return merged

    def _separated(self, merged: MergedProducts) -> SeparatedCloud:
        self.ground = self._noted(merged).separated.plane
        return merged.separated

    def _scan(self, merged: MergedProducts, limits: OutputLimits) -> Scan:
        return scan_of(self._separated(merged), limits.scan, limits.obstacles.max_range)

    def _camera_messages(
        self, result: SurroundDepth, index: int, stamp: int, frame_id: str, least: float
    ) -> dict[str, Callable[[], Any]]:
        """Return how to build each of one camera's messages; clouds of pixels with at least that confidence."""
        make, intrinsics, picture = self._factory, result.intrinsics[index], result.pictures[index]
        size, confidence = result.depth[index].shape, result.confidence
        builders: dict[str, Callable[[], Any]] = {
            DEPTH: lambda: self._depth_image(stamp, frame_id, result, index),
            DEPTH_INFO: lambda: make.camera_info(stamp, frame_id, intrinsics, *size),
            PICTURE: lambda: make.colour_image(stamp, frame_id, picture),
            PICTURE_INFO: lambda: make.camera_info(stamp, frame_id, intrinsics, *size),
            CLOUD: lambda: make.point_cloud(stamp, frame_id, organised_cloud(result, index, least)),
        }
        if confidence is not None:
            builders[CONFIDENCE] = lambda: make.confidence_image(stamp, frame_id, confidence[index])
        return builders
