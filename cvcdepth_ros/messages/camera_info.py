# SPDX-License-Identifier: Apache-2.0
"""`sensor_msgs/CameraInfo` as drivers fill it in: what says plainly the same in another way is understood, and told."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration, calibration_from_fields

_MAX_COEFFICIENTS = 100
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
# Names that drivers and converters give to pictures without distortion.
_NO_DISTORTION = {"", "none", "pinhole", "perspective", "no_distortion", "undistorted", "rectified", "ideal", "unknown"}
_PLUMB_BOB, _RATIONAL = "plumb_bob", "rational_polynomial"
# How many coefficients a model needs; further ones belong to the next model, and zeros say nothing.
_LENGTHS = {_PLUMB_BOB: (4, 5), _RATIONAL: (8, 12, 14), "equidistant": (4,)}


class ReadCameraInfo(NamedTuple):
    """A validated CameraInfo."""

    calibration: Calibration
    notes: tuple[str, ...]
    """What was not said as CameraInfo.msg wants it, and how it was understood."""


MOST_UNCALIBRATED = 1000
"""How many CameraInfos of a topic are looked at for the first with a calibration."""


def is_uncalibrated(message: Any) -> bool:
    """Say whether a CameraInfo tells that the camera has no calibration (K all zeros), or none yet."""
    return not any(message.k)


def content_of(message: Any) -> tuple[Any, ...]:
    """Return everything that a CameraInfo says, but for its stamp, to be compared with another one's."""
    roi = message.roi
    return (
        message.header.frame_id,
        (message.width, message.height, message.distortion_model, message.binning_x, message.binning_y),
        (roi.x_offset, roi.y_offset, roi.width, roi.height),
        *(bytes(memoryview(getattr(message, field))) for field in "dkrp"),
    )


def is_usable(message: Any) -> bool:
    """Say whether a CameraInfo is valid."""
    try:
        read_camera_info(message, "")
    except RigError:
        return False
    return True


def read_camera_info(message: Any, camera: str) -> ReadCameraInfo:
    """Validate a CameraInfo; RigError names the camera and the first impossible field."""
    if len(message.d) > _MAX_COEFFICIENTS:
        raise RigError(f"camera {camera}: camera_info: {len(message.d)} numbers in d; no model takes so many")
    if is_uncalibrated(message):
        raise RigError(f"camera {camera}: camera_info: K[0] = 0: the camera is not calibrated")
    numbers = {field: [float(number) for number in getattr(message, field)] for field in "dkrp"}
    notes: list[str] = []
    if numbers["r"] and not any(numbers["r"]):
        numbers["r"] = _IDENTITY
        notes.append("R is all zeros, which means not set, and is taken for the identity")
    model, numbers["d"] = _distortion(str(message.distortion_model), numbers["d"], notes)
    region = message.roi
    calibration = calibration_from_fields(
        camera,
        {
            "width": int(message.width),
            "height": int(message.height),
            "distortion_model": model,
            **numbers,
            # CameraInfo.msg: a binning of 0 means 1.
            "binning_x": int(message.binning_x) or 1,
            "binning_y": int(message.binning_y) or 1,
            "roi": {name: int(getattr(region, name)) for name in ("x_offset", "y_offset", "width", "height")},
        },
    )
    return ReadCameraInfo(calibration, tuple(notes))


def _distortion(name: str, d: list[float], notes: list[str]) -> tuple[str, list[float]]:
    """Return model and coefficients, in one of the numbers that the model takes where that says the same."""
    model = name.strip().lower()
    if model in _NO_DISTORTION and not any(d):
        if model:
            notes.append(f"distortion_model '{name}' without coefficients is taken for no distortion")
        return _PLUMB_BOB, []
    if model not in _LENGTHS:
        return name, d
    lengths = _LENGTHS[model]
    if len(d) in (0, *lengths):
        return model, d
    used = max((number for number, value in enumerate(d, 1) if value), default=0)
    if model == _PLUMB_BOB and used > max(lengths) and len(d) in _LENGTHS[_RATIONAL]:
        notes.append(f"{name} with {len(d)} numbers in d is taken for {_RATIONAL}, which has so many")
        return _RATIONAL, d
    return model, _resized(name, d, used, lengths, notes)


def _resized(name: str, d: list[float], used: int, lengths: Sequence[int], notes: list[str]) -> list[float]:
    """Return the coefficients with zeros at their end added or dropped, where that makes a number that is allowed."""
    is_padded = len(d) > max(lengths)
    wanted = max(lengths) if is_padded else min((length for length in lengths if length > len(d)), default=0)
    # A shorter list than any model has may have been cut; only zeros say nothing in any case.
    can_grow = not used or (name.strip().lower() == _RATIONAL and len(d) in _LENGTHS[_PLUMB_BOB])
    if used > wanted or not (is_padded or can_grow):
        return d
    notes.append(f"{name} with {len(d)} numbers in d, of which {used} matter, is read as one with {wanted}")
    return [*d, *[0.0] * wanted][:wanted]
