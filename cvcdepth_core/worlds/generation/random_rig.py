# SPDX-License-Identifier: Apache-2.0
"""Rigs thought up from a seed: any number of cameras, at any height, with any lens."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.worlds.generation.dice import Dice

_SHAPES = ((1600, 900), (1920, 1080), (1280, 960), (1936, 1216), (1920, 1200), (1280, 800))


def random_rig(seed: int, cameras: int | None = None) -> RigLayout:
    """Think up a rig of 2 to 8 cameras around a vehicle or robot, at 0.5 to 2.5 m; the same for the same seed."""
    dice = Dice(seed, 211)
    count = cameras or dice.pick(2, 3, 4, 5, 6, 6, 6, 7, 8)
    height, view = dice.scale(0.6, 2.4), dice.between(50, 112)
    if count <= 4:
        view = max(view, 70.0)
    pitch = dice.normal(4.0)
    reach = (dice.between(0.25, 1.9), dice.between(0.15, 0.85))
    shape, model = (
        dice.pick(*_SHAPES),
        dice.weighted({"none": 0.5, "plumb_bob": 0.25, "rational_polynomial": 0.1, "equidistant": 0.15}),
    )
    first = 0.0 if dice.chance(0.8) else 180.0 / count
    spread = 360.0 if dice.chance(0.85) else dice.between(90, 200)
    entries = []
    for i in range(count):
        yaw = first + spread * i / count - (spread / 2 if spread < 360 else 0.0) + dice.normal(5.0)
        own_view = view + dice.normal(1.5) if dice.chance(0.75) else dice.between(45, 110)
        pose = _mount(yaw, pitch + dice.normal(1.5), dice.normal(0.8), _place(dice, yaw, reach, height))
        entries.append(_camera(f"camera_{i}", _calibration(dice, shape, own_view, model), pose))
    return RigLayout(cameras=tuple(entries))


def _place(dice: Dice, yaw: float, reach: tuple[float, float], height: float) -> tuple[float, float, float]:
    a = math.radians(yaw)
    x, y = reach[0] * math.cos(a) + dice.normal(0.06), reach[1] * math.sin(a) + dice.normal(0.03)
    return round(x, 3), round(y, 3), round(min(2.6, max(0.5, height + dice.normal(0.05))), 3)


def _mount(yaw: float, pitch: float, roll: float, place: tuple[float, float, float]) -> Pose:
    """Return base_T_camera of a camera that looks so many degrees to the left and up, rolled about its axis."""
    a, p, r = (math.radians(angle) for angle in (yaw, pitch, roll))
    forward = np.array([math.cos(a) * math.cos(p), math.sin(a) * math.cos(p), math.sin(p)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack(
        [math.cos(r) * right + math.sin(r) * down, -math.sin(r) * right + math.cos(r) * down, forward], axis=1
    )
    pose[:3, 3] = place
    return pose


def _calibration(dice: Dice, shape: tuple[int, int], view: float, model: str) -> dict[str, Any]:
    """Return a calibration of a horizontal field of view, degrees."""
    width, height = shape
    half = math.radians(min(max(view, 40.0), 115.0)) / 2
    focal = width / 2 / (half if model == "equidistant" else math.tan(half))
    k1, k2 = dice.normal(0.02, 4), dice.normal(0.004, 4)
    d: dict[str, list[float]] = {
        "none": [],
        "plumb_bob": [k1, k2, dice.normal(3e-4, 6), dice.normal(3e-4, 6), 0.0],
        "rational_polynomial": [k1 + 0.3, k2 + 0.02, 0.0, 0.0, 0.0, 0.3, 0.02, 0.0],
        "equidistant": [k1, k2, 0.0, 0.0],
    }
    fx, fy = focal * math.exp(dice.normal(0.004, 5)), focal
    cx, cy = (width - 1) / 2 + width * dice.normal(0.008, 5), (height - 1) / 2 + width * dice.normal(0.008, 5)
    return {
        "width": width,
        "height": height,
        "distortion_model": "plumb_bob" if model == "none" else model,
        "d": d[model],
        "k": [round(fx, 3), 0.0, round(cx, 3), 0.0, round(fy, 3), round(cy, 3), 0.0, 0.0, 1.0],
    }


def _camera(name: str, calibration: dict[str, Any], pose: Pose) -> CameraEntry:
    return CameraEntry.model_validate(
        {
            "name": name,
            "image_topic": f"/camera/{name}/image_raw/compressed",
            "camera_info_topic": f"/camera/{name}/camera_info",
            "frame_id": f"{name}_optical_frame",
            "calibration": calibration,
            "base_T_camera": PoseEntry.from_matrix(pose),
        }
    )
