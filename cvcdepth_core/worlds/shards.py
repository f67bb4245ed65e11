# SPDX-License-Identifier: Apache-2.0
"""Simulated drives as single files for training: pictures, depth as half floats, labels, calibration and motion.

A shard is a zip file without compression of its own: `drive.json`, and in a folder for each set every camera's picture
(`NAME.jpg`), depth (`NAME.depth`) and labels (`NAME.labels`), the last two packed by Zstandard.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray
from pydantic import ValidationError

from cvcdepth_core.errors import RecordingError, first_validation_message
from cvcdepth_core.files import write_atomically
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.worlds.drive import DriveSpec, Shot, SimulatedDrive
from cvcdepth_core.worlds.world import OWN_VEHICLE

SUFFIX = ".shard.zip"
STATIC, SKY_LABEL, MOVING, OWN = 0, 1, 2, 3
"""Labels of pixels."""
_INDEX = "drive.json"
_FORMAT = 1
_LEVEL = 6  # of Zstandard
_EPOCH = (1980, 1, 1, 0, 0, 0)  # what zip files begin to count from: the same bytes at any time
PictureForm = Literal["jpeg", "png"]


def write_shard(path: Path, spec: DriveSpec, form: PictureForm = "jpeg", quality: int = 92) -> None:
    """Simulate a drive into a shard, which is there whole or not at all; the same bytes for the same arguments."""
    drive = SimulatedDrive(spec)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, data in _entries(drive, form, quality):
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    write_atomically(path, content.getvalue())


def _entries(drive: SimulatedDrive, form: PictureForm, quality: int) -> Iterator[tuple[str, bytes]]:
    yield _INDEX, json.dumps(_index(drive, form)).encode()
    for number in range(drive.spec.sets):
        for camera, name in enumerate(drive.rig.names):
            shot = drive.shoot(camera, number)
            stem = f"{number:04d}/{name}"
            yield f"{stem}.{_SUFFIXES[form]}", _encoded(shot.picture, form, quality)
            yield f"{stem}.depth", packed_depth(shot.truth.depth)
            yield f"{stem}.labels", zstandard.compress(labels(shot).tobytes(), _LEVEL)


_SUFFIXES: dict[PictureForm, str] = {"jpeg": "jpg", "png": "png"}


def _index(drive: SimulatedDrive, form: PictureForm) -> dict[str, Any]:
    spec = drive.spec
    times = [[spec.camera_time(camera, number) for camera in drive.rig.cameras] for number in range(spec.sets)]
    return {
        "format": _FORMAT,
        "pictures": form,
        "world": {"name": spec.world.name, "kind": spec.world.kind, "seed": spec.world.seed},
        "weather": spec.world.sky.weather,
        "sets": spec.sets,
        "seconds": times,
        "world_T_base": [[drive.way.pose(time).tolist() for time in row] for row in times],
        "rig": spec.layout.model_dump(mode="json", exclude_defaults=True),
    }


def _encoded(picture: NDArray[np.uint8], form: PictureForm, quality: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if form == "jpeg" else []
    _, encoded = cv2.imencode(f".{_SUFFIXES[form]}", np.ascontiguousarray(picture[..., ::-1]), options)
    return bytes(encoded)


def labels(shot: Shot) -> NDArray[np.uint8]:
    """Return what each pixel [H, W] shows: STATIC, SKY_LABEL, MOVING or OWN."""
    found = np.where(shot.truth.moving, MOVING, STATIC).astype(np.uint8)
    found[np.isinf(shot.truth.depth)] = SKY_LABEL
    found[shot.truth.objects == OWN_VEHICLE] = OWN
    return found


def packed_depth(depth: NDArray[np.float64]) -> bytes:
    """Pack depth [H, W], metres, as half floats: rows as differences, high bytes before low ones, by Zstandard."""
    bits = np.minimum(depth, 65000.0).astype(np.float16)
    bits[np.isinf(depth)] = np.inf
    differences = np.diff(bits.view(np.uint16), axis=1, prepend=np.uint16(0))
    planes = differences.astype("<u2").view(np.uint8).reshape(*depth.shape, 2)
    return zstandard.compress(np.moveaxis(planes[..., ::-1], -1, 0).tobytes(), _LEVEL)


def unpacked_depth(content: bytes, height: int, width: int) -> NDArray[np.float32]:
    """Return what `packed_depth` packed, float32 [H, W]; ValueError where it does not fit."""
    planes = np.frombuffer(zstandard.decompress(content, max_output_size=2 * height * width), np.uint8)
    pairs = np.ascontiguousarray(np.moveaxis(planes.reshape(2, height, width)[::-1], 0, -1))
    bits = np.cumsum(pairs.view("<u2")[..., 0], axis=1, dtype=np.uint16)
    return bits.view(np.float16).astype(np.float32)


@dataclass(frozen=True)
class ShardSample:
    """One camera in one set."""

    picture: NDArray[np.uint8]
    """[H, W, 3] RGB."""
    depth: NDArray[np.float32]
    """[H, W] metres along the optical axis of the raw picture's pixels; inf for the sky."""
    labels: NDArray[np.uint8]
    """[H, W], see `labels`."""


class Shard:
    """A shard that is read; any number of processes may read the same."""

    def __init__(self, path: Path) -> None:
        """Read its index. RecordingError names the file and what is wrong with it."""
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                index = json.loads(archive.read(_INDEX))
            if index["format"] != _FORMAT:
                raise RecordingError(f"{path}: is of format {index['format']}, want {_FORMAT}")
            self.layout = RigLayout.model_validate(index["rig"])
            self.sets = int(index["sets"])
            self.seconds = np.array(index["seconds"], np.float64)
            self.world_T_base = np.array(index["world_T_base"], np.float64)
            self.kind, self.weather = str(index["world"]["kind"]), str(index["weather"])
            self._suffix = _SUFFIXES[index["pictures"]]
        except ValidationError as error:
            raise RecordingError(f"{path}: rig: {first_validation_message(error)}") from error
        except (OSError, zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{path}: is no shard of a simulated drive: {error}") from error

    def sample(self, number: int, camera: str) -> ShardSample:
        """Return one camera's picture and truth in a set; RecordingError names what cannot be read."""
        stem = f"{number:04d}/{camera}"
        try:
            with zipfile.ZipFile(self.path) as archive:
                parts = [archive.read(f"{stem}.{suffix}") for suffix in (self._suffix, "depth", "labels")]
            picture: Any = cv2.imdecode(np.frombuffer(parts[0], np.uint8), cv2.IMREAD_COLOR)
            height, width = picture.shape[:2]
            flat = np.frombuffer(zstandard.decompress(parts[2], max_output_size=height * width), np.uint8)
            depth = unpacked_depth(parts[1], height, width)
            return ShardSample(np.ascontiguousarray(picture[..., ::-1]), depth, flat.reshape(height, width))
        except (OSError, zipfile.BadZipFile, KeyError, ValueError, AttributeError, zstandard.ZstdError) as error:
            raise RecordingError(f"{self.path}: {stem}: cannot be read: {error}") from error
