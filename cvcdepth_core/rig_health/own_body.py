# SPDX-License-Identifier: Apache-2.0
"""Finds the vehicle's own body in its cameras' pictures: it stands still in the picture while the scene moves.

For a pixel of the scene below the horizon, the ground bounds the distance from above, so that the vehicle's motion must
move it by a known number of pixels at least. There the change from one picture to a later one is compared with the
change that a shift by one pixel in that direction would make. Where the picture has texture, the change is far smaller,
and the texture is still there in the mean of all pictures, it shows the vehicle: a road has little texture and changes
little, but what it shows now is not what it shows later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RigError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.rectifier import raw_pixels
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.pinhole import pixel_rays
from cvcdepth_core.rig.rig import Camera, Rig

MIN_TRAVEL = 0.5
"""Metres that the vehicle moves between the two pictures of a pair, at least."""
MIN_PAIRS = 8
"""Pairs of pictures that are needed for a result."""

_WIDTH = 384  # pixels: fine enough for a bumper, coarse enough that a metre of travel moves the near scene by many
_MIN_SHIFT = 1.0  # pixels that the ground moves within MIN_TRAVEL where a pixel is looked at
_MIN_CAMERA_HEIGHT = 0.5  # metres above the ground, where the base frame lies as high as the cameras
_WINDOW = 9  # pixels over which changes are summed up
_SEED_TEXTURE, _SEED_RATIO, _GROWN_RATIO = 0.7, 0.7, 1.5  # grey levels per pixel; change by change of one pixel's shift
_LEAST_PERSISTENCE = 0.6  # share of a seed's texture that is left in the mean of the pictures; of scene 0.1 to 0.4
_FADING_CHANGE, _FADING_PERSISTENCE = 0.2, 0.35  # grey levels; share of the texture: what is no body however smooth
_NOISE_PERCENTILE = 5
_MAX_NOISE = 0.5  # grey levels that may count as noise: where no body is seen, the stillest picture is of a road
_MIN_SEED_SHARE = 0.002
_ALONG = 0.7  # of the optical axis that points along the vehicle
_BORDER, _MIN_BORDER_SEEDS = 12, 20  # pixels from the border, and how many seeds a body has there at least
_CLOSING = 15  # pixels: gaps in the outline of the body that are closed


def lane_share(camera: Camera, scene: NDArray[np.bool_]) -> float:
    """Return which share of where the vehicle drives a mask takes away: 0 for a camera that looks aside.

    `scene` [H, W] is False where the mask is. The lane ahead, or behind, is the lower middle of a camera that looks
    along the vehicle: what is masked there by mistake is what matters most.
    """
    if abs(float(camera.base_T_camera[0, 2])) < _ALONG:
        return 0.0
    height, width = scene.shape
    return float((~scene[2 * height // 3 :, width // 3 : 2 * width // 3]).mean())


class SelfOcclusionFinder:
    """Collects pairs of surround sets between which the vehicle has moved, and separates body from scene.

    Assumes straight driving forward or backward, which most of a log is, and ground near the base frame's height.
    """

    def __init__(self, rig: Rig) -> None:
        image_width, image_height = rig.cameras[0].calibration.image_size
        self.rig = rig
        self.preprocessor = SurroundPreprocessor(rig, round(_WIDTH * image_height / image_width), _WIDTH)
        """Rectifies the pictures that `add` takes."""
        flows = [
            _ground_flow(camera, K, *self.preprocessor.valid.shape[1:])
            for camera, K in zip(rig.cameras, self.preprocessor.intrinsics, strict=True)
        ]
        lengths = np.linalg.norm(flows, axis=-1)
        self._directions = np.array(flows) / np.maximum(lengths, 1e-9)[..., None]
        self._examined = (lengths >= _MIN_SHIFT) & self.preprocessor.valid
        self._changes = np.zeros(lengths.shape)
        self._shift_changes = np.zeros(lengths.shape)
        self._slopes = np.zeros(lengths.shape)
        self.pairs = 0
        """Pairs that were added."""

    def add(self, earlier: Sequence[Picture], later: Sequence[Picture]) -> None:
        """Take two sets' rectified pictures, RGB [H, W, 3] in the rig's order, at least MIN_TRAVEL metres apart."""
        for camera, pictures in enumerate(zip(earlier, later, strict=True)):
            before, after = map(_smooth_grey, pictures)
            gradient = np.stack([cv2.Sobel(before, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))], -1)
            slope = (gradient * self._directions[camera]).sum(axis=-1)
            self._slopes[camera] += slope
            self._shift_changes[camera] += abs(slope)
            self._changes[camera] += abs(after - before)
        self.pairs += 1

    def scene(self) -> NDArray[np.bool_]:
        """Return where each rectified picture shows the scene [N, H, W], False on the vehicle itself.

        Without MIN_PAIRS pairs nothing is known and everything counts as scene. RigError when no camera sees ground.
        """
        if self.pairs < MIN_PAIRS:
            return np.ones_like(self._examined)
        if not self._examined.any():
            raise RigError(
                f"camera {', '.join(self.rig.names)}: none sees ground, which its own body is told from: does "
                "frame_id name the optical frame, whose z looks forward and whose y looks down?"
            )
        changes, textures, lasting = (
            np.stack([cv2.blur(image / self.pairs, (_WINDOW, _WINDOW)) for image in sums])
            for sums in (self._changes, self._shift_changes, abs(self._slopes))
        )
        excess = np.maximum(changes - self._noise(changes), 0)
        ratios = excess / np.maximum(textures, 1e-3)
        lasts = lasting > _LEAST_PERSISTENCE * textures
        seeds = self._examined & (textures > _SEED_TEXTURE) & (ratios < _SEED_RATIO) & lasts
        # A smooth road, and the shadow on it of a vehicle that follows, change little, but not only by noise.
        fades = (excess > _FADING_CHANGE) & (lasting < _FADING_PERSISTENCE * textures)
        grown = self._examined & (ratios < _GROWN_RATIO) & ~fades
        seen = self.preprocessor.valid
        return np.stack([~_enclosed(_connected(*still)) for still in zip(grown, seeds, seen, strict=True)])

    def raw_mask(self, camera: int, scene: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return `scene` [H, W] of a camera as a mask of its raw image's size: 0 on the vehicle, 255 elsewhere."""
        found = self.rig.cameras[camera]
        pixels = raw_pixels(found.calibration, found.rectified, self.preprocessor.intrinsics[camera])
        grey = np.where(scene, 255, 0).astype(np.uint8)
        mask: NDArray[np.uint8] = cv2.remap(grey, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.where(mask > 127, 255, 0).astype(np.uint8)

    def _noise(self, changes: NDArray[np.float64]) -> float:
        """Return how much noise alone changes, grey levels: the stillest picture shows it, if that is of a body."""
        parts = [change[part] for change, part in zip(changes, self._examined, strict=True) if part.any()]
        return min(_MAX_NOISE, *(float(np.percentile(part, _NOISE_PERCENTILE)) for part in parts))


def _ground_flow(camera: Camera, intrinsics: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64]:
    """Return how the ground moves in the picture during MIN_TRAVEL, [H, W, 2]; 0 above the horizon."""
    rays = pixel_rays(intrinsics, height, width).astype(np.float64)
    base_R_camera = camera.base_T_camera[:3, :3]
    descent = -(rays @ base_R_camera[2])
    depth = max(float(camera.base_T_camera[2, 3]), _MIN_CAMERA_HEIGHT) / np.maximum(descent, 1e-6)
    moved = rays * depth[..., None] - MIN_TRAVEL * base_R_camera[0]
    pixels = moved @ intrinsics.T
    in_front = (descent > 0) & (pixels[..., 2] > 1e-3)
    flow = pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-3) - (rays @ intrinsics.T)[..., :2]
    return np.where(in_front[..., None], flow, 0.0)


def _smooth_grey(picture: Picture) -> NDArray[np.float32]:
    """Return the picture in grey levels, float32, so smooth that its gradient tells what a shift by a pixel changes."""
    grey: NDArray[np.float32] = cv2.GaussianBlur(
        cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1
    )
    return grey


def _connected(grown: NDArray[np.bool_], seeds: NDArray[np.bool_], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the parts of `grown` that hold enough of `seeds`, at the border of what is `seen` too, gaps closed."""
    least = _MIN_SEED_SHARE * seeds.size
    still = _parts(grown, lambda part: int((part & seeds).sum()) >= least)
    closed = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_CLOSING, _CLOSING), np.uint8)) > 0
    # What floats inside the picture is a vehicle that drives along, not our own, even if a smooth road leads from it to
    # the border.
    at_border = seeds & ~_inner(seen)
    return _parts(closed, lambda part: int((part & at_border).sum()) >= _MIN_BORDER_SEEDS)


def _inner(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what is not near the left, the right or the lower border of what the lens shows."""
    inner = np.zeros_like(seen)
    left, right = seen[:-_BORDER, : -2 * _BORDER], seen[:-_BORDER, 2 * _BORDER :]
    inner[:-_BORDER, _BORDER:-_BORDER] = left & right & seen[_BORDER:, _BORDER:-_BORDER]
    return inner


def _enclosed(body: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Add what the body separates from the sky: the untextured inside of a hood or a roof."""
    sky_above = np.pad(~body, ((1, 0), (0, 0)), constant_values=True)
    _, labels = cv2.connectedComponents(sky_above.astype(np.uint8), connectivity=4)
    inside: NDArray[np.bool_] = (labels != labels[0, 0])[1:]
    return inside


def _parts(region: NDArray[np.bool_], is_wanted: Callable[[NDArray[np.bool_]], bool]) -> NDArray[np.bool_]:
    """Return the connected parts of `region` that are wanted."""
    count, labels = cv2.connectedComponents(region.astype(np.uint8))
    wanted = [label for label in range(1, count) if is_wanted(labels == label)]
    return np.isin(labels, wanted)
