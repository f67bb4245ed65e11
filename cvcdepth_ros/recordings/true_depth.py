# SPDX-License-Identifier: Apache-2.0
"""Ground truth from depth images that were recorded beside the pictures, as simulators record it. No ROS here.

Several views of one lens have its image, each along its own axis.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError, RecordingError
from cvcdepth_core.images.rectifier import raw_pixels
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.rig.wide_lenses import lens_name
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter, SparseDepth
from cvcdepth_ros.bags import RecordedMessage
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.truth import RecordedMotion

MOVING, EDGES = "moving", "edges"
"""Parts of the pixels that are scored apart: what moves by itself, and what is beside a step of depth."""

_STEP = 0.1  # of log depth, between two pixels
_BESIDE = 2  # pixels on both sides of a step
_LATE_NS = 300_000_000


class _TrueImage(NamedTuple):
    depth: NDArray[np.float32]
    """[H, W] metres along the optical axis of the raw picture's pixels; inf in the sky."""
    moving: NDArray[np.bool_]
    """[H, W]."""


def depth_topic(camera: str) -> str:
    """Return the topic of a camera's true depth."""
    return f"/camera/{camera}/truth/depth"


def moving_topic(camera: str) -> str:
    """Return the topic that says which pixels move by themselves; it may be missing."""
    return f"/camera/{camera}/truth/moving"


class RecordedDepthImages(RecordedMotion):
    """Dense ground truth, and the poses from the recording's motion; used as `RecordedTruth` is."""

    def __init__(self, recorded: RecordedRig) -> None:
        """RecordingError names the topic of a camera that has no true depth."""
        super().__init__(recorded)
        images = recorded.layout.views_by_image.values()
        self._lenses = {name: lens_name(names) for names in images for name in names}
        names = list(dict.fromkeys(self._lenses.values()))
        self._cameras = {depth_topic(name): name for name in names}
        self._movers = {moving_topic(name): name for name in names if moving_topic(name) in self._recording.topics}
        missing = [topic for topic in self._cameras if topic not in self._recording.topics]
        if missing:
            raise RecordingError(
                f"{self._recording.path}: no true depth on {', '.join(missing)}; --truth depth needs that of every "
                "camera, as `simulate` records it"
            )
        self.topics = tuple(self._cameras)
        self.ahead_ns = _LATE_NS
        self._offsets = {self._lenses[entry.name]: entry.stamp_offset_ns for entry in recorded.layout.cameras}
        self._images: dict[str, dict[int, Any]] = defaultdict(dict)
        self.handlers: Mapping[str, Callable[[RecordedMessage], None]] = {
            **dict.fromkeys((*self._cameras, *self._movers), self._add_image),
            **self.handlers,
        }

    def points(self, time: int) -> None:
        """There is no LiDAR."""

    def camera_depth(self, rig: Rig, times: Mapping[str, int], occlusion: OcclusionFilter | None) -> list[SparseDepth]:
        """Return each camera's true depth of its picture (ns), rectified at full size; empty where it is missing."""
        return [self._of_camera(camera, times[camera.name]) for camera in rig.cameras]

    def forget_before(self, stamp: int) -> None:
        """Drop what no moment (ns) at or after this one needs."""
        super().forget_before(stamp)
        for images in self._images.values():
            for old in [time for time in images if time < stamp]:
                del images[old]

    def _of_camera(self, camera: Camera, time: int) -> SparseDepth:
        width, height = camera.calibration.image_size
        empty = np.zeros(0, np.int64)
        with self.refused.instead_of_errors():
            return rectified_truth(camera, self._image(camera.name, (height, width), time))
        return SparseDepth(empty, empty, np.zeros(0), height, width)

    def _image(self, camera: str, shape: tuple[int, int], time: int) -> _TrueImage:
        lens = self._lenses[camera]
        found = self._images[depth_topic(lens)].get(time)
        if found is None:
            raise ImageError(f"camera {camera}: no true depth with the stamp of its picture, {time} ns")
        depth = _pixels(found, camera, "32FC1", "<f4", shape)
        moving = self._images[moving_topic(lens)].get(time)
        movers = np.zeros(shape, np.uint8) if moving is None else _pixels(moving, camera, "mono8", "u1", shape)
        return _TrueImage(depth.astype(np.float32), movers > 0)

    def _add_image(self, message: RecordedMessage) -> None:
        with self.refused.instead_of_errors():
            content = self._recording.deserialize(message)
            camera = self._cameras.get(message.topic) or self._movers[message.topic]
            self._images[message.topic][stamp_ns(content) - self._offsets[camera]] = content


def _pixels(message: Any, camera: str, encoding: str, dtype: str, shape: tuple[int, int]) -> NDArray[Any]:
    """Return the pixels of an image message; ImageError names what is not as it has to be."""
    found = (message.encoding, message.height, message.width)
    if found != (encoding, *shape):
        raise ImageError(f"camera {camera}: truth is {found}, expected {(encoding, *shape)} as the picture")
    order = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(bytes(message.data), np.uint8)
    if rows.size < message.height * message.step or message.step < message.width * order.itemsize:
        raise ImageError(f"camera {camera}: truth has {rows.size} bytes in rows of {message.step}, too few")
    rows = rows[: message.height * message.step].reshape(message.height, message.step)
    return np.ascontiguousarray(rows[:, : message.width * order.itemsize]).view(order)


def rectified_truth(camera: Camera, image: _TrueImage) -> SparseDepth:
    """Bring the truth of a raw picture's pixels to the rectified picture of full size; the nearest of each pixel."""
    calibration = camera.calibration
    intrinsics = calibration.rectified_intrinsics
    pixels = raw_pixels(calibration, camera.rectified, intrinsics).astype(np.float64)
    height, width = image.depth.shape
    u, v = np.floor(pixels.reshape(-1, 2) + 0.5).T
    with np.errstate(invalid="ignore"):
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (image.depth.ravel() > 0)
    depth = (image.depth * _stretch(camera, pixels, intrinsics)).ravel()[inside].astype(np.float64)
    flat = v[inside].astype(np.int64) * width + u[inside].astype(np.int64)
    nearest_first = np.argsort(depth, kind="stable")
    pixel, first = np.unique(flat[nearest_first], return_index=True)
    chosen = nearest_first[first]
    rows, columns = np.divmod(pixel, width)
    depth, parts = depth[chosen], {}
    for name, mask in ((MOVING, image.moving), (EDGES, edges(image.depth))):
        parts[name] = mask.ravel()[inside][chosen]
    near = np.isfinite(depth)
    sky = np.stack([rows[~near], columns[~near]], axis=1)
    parts = {name: mask[near] for name, mask in parts.items()}
    return SparseDepth(rows[near], columns[near], depth[near], height, width, parts, sky)


def _stretch(
    camera: Camera, pixels: NDArray[np.float64], intrinsics: NDArray[np.float64]
) -> NDArray[np.float64] | float:
    """Return depth along the rectified picture's axis over that along the raw one's [H, W]; 1 for parallel axes."""
    rotation = camera.calibration.rotation
    if camera.rectified or np.allclose(rotation, np.eye(3), atol=1e-12):
        return 1.0
    rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1) @ np.linalg.inv(intrinsics).T
    along: NDArray[np.float64] = 1.0 / (rays @ rotation[:, 2])
    return along


def edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels [H, W] are beside a step of depth, or of the sky's outline."""
    log_depth = np.log(np.minimum(depth, 1e4))
    step = np.zeros(depth.shape, np.uint8)
    step[:, 1:] |= np.abs(np.diff(log_depth, axis=1)) > _STEP
    step[1:] |= np.abs(np.diff(log_depth, axis=0)) > _STEP
    beside = cv2.dilate(step, np.ones((2 * _BESIDE, 2 * _BESIDE), np.uint8), anchor=(_BESIDE - 1, _BESIDE - 1))
    return np.asarray(beside > 0)
