# SPDX-License-Identifier: Apache-2.0
"""Training samples from shards of simulated drives: single views with exact depth, each of a rig of its own. No ROS."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig import Camera
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import TrainingConfig, WorldsConfig
from cvcdepth_core.training.distributed import SINGLE_PROCESS, Processes
from cvcdepth_core.training.trainer import RehearsedBatch
from cvcdepth_core.worlds.shards import SUFFIX, Shard

_NAME = "view"  # of the only camera of a sample
_OF_EPOCHS, _OF_REHEARSAL = 1, 2
"""Tell the draws of windows apart."""


class View(NamedTuple):
    """One camera in one set of a shard."""

    shard: int
    set: int
    camera: int


class WorldView(NamedTuple):
    """A view as the network takes it."""

    picture: NDArray[np.uint8]
    """[H, W, 3] RGB, rectified."""
    truth: NDArray[np.float32]
    """[H, W] metres along the optical axis; inf in the sky, NaN outside of the raw picture."""
    intrinsics: NDArray[np.float64]
    """[3, 3] in pixels of H x W."""
    base_T_camera: NDArray[np.float64]
    """[4, 4] with the ground at z = 0."""


def find_shards(folders: Sequence[Path]) -> list[Path]:
    """Return the shards in `folders`, in order of their names; RecordingError names a folder without any."""
    found = []
    for folder in folders:
        shards = sorted(folder.glob(f"*{SUFFIX}"))
        if not shards:
            raise RecordingError(f"{folder}: no shards (*{SUFFIX}) there; `cvcdepth simulate --many` writes them")
        found += shards
    return found


class ViewReader:
    """Random access to the views of shards."""

    def __init__(self, paths: Sequence[Path], height: int, width: int) -> None:
        """Read what each shard holds; RecordingError names one that is damaged."""
        self.height, self.width = height, width
        self._shards = [Shard(path) for path in paths]
        self._cameras = [shard.layout.complete().cameras for shard in self._shards]
        self._ground_heights = [shard.layout.ground_z for shard in self._shards]
        self.views = [
            View(i, number, camera)
            for i, shard in enumerate(self._shards)
            for number in range(shard.sets)
            for camera in range(len(shard.layout.cameras))
        ]

    def read(self, view: View, config: WorldsConfig, rng: np.random.Generator | None) -> WorldView:
        """Return a view: a random window of it, told a little wrong, by `rng`; the whole as it is, without.

        RecordingError names a picture that cannot be read.
        """
        camera = self._cameras[view.shard][view.camera]
        calibration = camera.calibration
        sample = self._shards[view.shard].sample(view.set, camera.name)
        intrinsics = _window(calibration, self.height, self.width, config, rng)
        maps = _sampling_maps(camera, intrinsics, (self.width, self.height))
        picture = cv2.remap(sample.picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        truth = cv2.remap(sample.depth, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan)
        base_T_camera = camera.base_T_camera.copy()
        base_T_camera[2, 3] -= self._ground_heights[view.shard]
        if rng is not None:
            base_T_camera = told_wrongly(base_T_camera, config, rng)
        return WorldView(np.asarray(picture, np.uint8), np.asarray(truth, np.float32), intrinsics, base_T_camera)


def _window(
    calibration: Calibration, height: int, width: int, config: WorldsConfig, rng: np.random.Generator | None
) -> NDArray[np.float64]:
    """Return the intrinsics of a window of the rectified picture, resized to height x width."""
    full_width, full_height = calibration.image_size
    across, down, left, top = float(full_width), float(full_height), 0.0, 0.0
    if rng is not None:
        share = rng.uniform(1 / config.zoom, 1.0)
        squeezed = math.exp(rng.normal(0, config.squeeze)) * (height / width) / (full_height / full_width)
        across, down = full_width * share * min(1.0, 1 / squeezed), full_height * share * min(1.0, squeezed)
        left, top = rng.uniform(0, full_width - across), rng.uniform(0, full_height - down)
    scale = np.array([width / across, height / down])
    intrinsics: NDArray[np.float64] = calibration.rectified_intrinsics.copy()
    intrinsics[:2, :2] *= scale[:, None]
    intrinsics[:2, 2] = (intrinsics[:2, 2] + 0.5 - (left, top)) * scale - 0.5
    return intrinsics


def _sampling_maps(camera: Camera, intrinsics: NDArray[np.float64], size: tuple[int, int]) -> tuple[Any, Any]:
    """Return where each pixel of the window lies in the raw picture."""
    calibration = camera.calibration
    fisheye = calibration.distortion_model == "equidistant"
    build = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    distortion, rotation = calibration.distortion, calibration.rotation
    x, y = build(calibration.raw_intrinsics, distortion, rotation, intrinsics, size, cv2.CV_32FC1)
    return x, y


def told_wrongly(
    base_T_camera: NDArray[np.float64], config: WorldsConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return a pose [4, 4] with the errors of a rig file: the vehicle's pitch and roll, and the camera's height."""
    pitch, roll = np.radians(rng.normal(0, config.angle_error, 2))
    turn, _ = cv2.Rodrigues(np.array([roll, pitch, 0.0]))
    told: NDArray[np.float64] = base_T_camera.copy()
    told[:3, :3] = turn @ told[:3, :3]
    told[2, 3] *= math.exp(rng.normal(0, config.height_error))
    return told


class WorldBatches:
    """Batches of views from everywhere, each a rig of one camera; the order depends on seed and epoch only."""

    def __init__(self, paths: Sequence[Path], config: TrainingConfig, processes: Processes = SINGLE_PROCESS) -> None:
        """ConfigError when no drive is left to train on; RecordingError names a damaged shard."""
        self.reader, self.held_out = read_drives(paths, config)
        self._config = config.worlds
        self._seed = config.seed
        self._processes = processes
        self._together = config.optimizer.samples_per_batch * processes.count

    @property
    def samples(self) -> int:
        """Views of one epoch, of all processes together."""
        return len(self.reader.views)

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch | None]:
        """Yield the batches of an epoch from number `first` on; None for one that could not be read."""
        order = np.random.default_rng([self._seed, number]).permutation(self.samples)
        for start in range(first * self._together, self.samples, self._together):
            chosen = order[start : start + self._together].tolist()
            mine = [chosen[i % len(chosen)] for i in range(self._processes.rank, self._together, self._processes.count)]
            yield self._batch(mine[: max(1, math.ceil(len(chosen) / self._processes.count))], number)

    def _batch(self, chosen: Sequence[int], epoch: int) -> RigBatch | None:
        drawn = [(item, np.random.default_rng([self._seed, epoch, item, _OF_EPOCHS])) for item in chosen]
        return _batch(self.reader, self._config, drawn)


class WorldRehearsal:
    """The views of worlds that a training on recordings learns from too, as many in every step.

    They are every view once in a random order, then all in another one, and so on; which ones a step has depends on
    the seed and its number only.
    """

    name = "worlds"

    def __init__(
        self,
        reader: ViewReader,
        config: TrainingConfig,
        cameras: float,
        processes: Processes = SINGLE_PROCESS,
    ) -> None:
        """Take views from `reader` beside samples of recordings that have `cameras` pictures each, on average.

        ConfigError when there is not a view for every process.
        """
        self.views_per_step = views_per_step(config, cameras)
        self.weight = config.worlds.weight / cameras
        if self.views_per_step < processes.count:
            raise ConfigError(
                f"worlds.share is {config.worlds.share}: that is {self.views_per_step} views in each step, fewer than "
                f"the {processes.count} processes"
            )
        self._reader, self._config, self._seed = reader, config.worlds, config.seed
        self._processes = processes
        # About as many pictures go through the networks together as of recordings.
        together = max(2, round(config.optimizer.samples_per_batch * cameras)) * processes.count
        self._parts = math.ceil(self.views_per_step / together)

    def of_step(self, number: int) -> Iterator[RehearsedBatch]:
        """See `Rehearsal`."""
        places = np.arange(number * self.views_per_step, (number + 1) * self.views_per_step)
        for part in np.array_split(places, self._parts):
            mine = part[self._processes.rank :: self._processes.count].tolist()
            batch = _batch(self._reader, self._config, [self._drawn(place) for place in mine])
            yield RehearsedBatch(int(part[0] - places[0]), batch)

    def _drawn(self, place: int) -> tuple[int, np.random.Generator]:
        """Return the view at a place of the endless order, and what its window is drawn with."""
        turn, within = divmod(place, len(self._reader.views))
        item = int(np.random.default_rng([self._seed, turn]).permutation(len(self._reader.views))[within])
        return item, np.random.default_rng([self._seed, turn, item, _OF_REHEARSAL])


def views_per_step(config: TrainingConfig, cameras: float) -> int:
    """Return how many views of worlds come with a step's samples of recordings, of `cameras` pictures each."""
    share = config.worlds.share
    return max(1, round(share / (1 - share) * config.optimizer.samples_per_step * cameras)) if share else 0


def read_drives(paths: Sequence[Path], config: TrainingConfig) -> tuple[ViewReader, ViewReader]:
    """Return the views that are trained on, and those of the last drives, which are held out.

    ConfigError when no drive is left to train on; RecordingError names a damaged shard.
    """
    kept = len(paths) - math.ceil(config.worlds.held_out * len(paths))
    if kept < 1:
        raise ConfigError(f"worlds.held_out is {config.worlds.held_out}: of {len(paths)} drives none is left")
    size = config.depth.height, config.depth.width
    return ViewReader(paths[:kept], *size), ViewReader(paths[kept:], *size)


def _batch(
    reader: ViewReader, config: WorldsConfig, drawn: Sequence[tuple[int, np.random.Generator]]
) -> RigBatch | None:
    """Return a batch of views, by their numbers, with random windows; None where none can be read."""
    views = []
    for item, rng in drawn:
        try:
            views.append(reader.read(reader.views[item], config, rng))
        except RecordingError:
            continue
    return batch_of_views(views) if views else None


def batch_of_views(views: Sequence[WorldView]) -> RigBatch:
    """Join views to samples of one camera each."""
    pictures = torch.from_numpy(np.stack([view.picture for view in views]))
    truth = torch.from_numpy(np.stack([view.truth for view in views]))[:, None, None]
    return RigBatch(
        frames=pictures.permute(0, 3, 1, 2)[:, None, None].float() / 255,
        masks=(~truth.isnan()).float(),
        intrinsics=torch.from_numpy(np.stack([view.intrinsics for view in views]))[:, None].float(),
        base_T_camera=torch.from_numpy(np.stack([view.base_T_camera for view in views]))[:, None].float(),
        targets=torch.zeros(0, dtype=torch.long),
        sources=torch.zeros(0, dtype=torch.long),
        camera_names=(_NAME,),
        truth=truth,
    )
