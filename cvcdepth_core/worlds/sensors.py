# SPDX-License-Identifier: Apache-2.0
"""The sensors of a vehicle in words and numbers: how cameras develop pictures, how a LiDAR turns, how odometry errs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cvcdepth_core.worlds.description import Part, Share
from cvcdepth_core.worlds.generation.dice import Dice

Positive = Annotated[float, Field(gt=0.0)]


class CameraLook(Part):
    """How a camera makes a picture of the light."""

    exposure: Literal["auto", "fixed"] = "auto"
    """Each picture by its own brightness, or all by that of the daylight."""
    key: Positive = 0.3
    """How bright the mean of a picture becomes, linear, 1 is white."""
    white_balance: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    gamma: Positive = 2.2
    contrast: Positive = 1.0
    saturation: float = Field(default=1.0, ge=0.0)
    vignetting: Share = 0.0
    """How much darker the corners are."""
    bloom: Share = 0.0
    """How much the brightest places spill over."""
    blur: float = Field(default=0.0, ge=0.0)
    """Standard deviation of the lens's blur, pixels."""
    sharpening: Share = 0.0
    noise: float = Field(default=0.0, ge=0.0, le=1.0)
    """Standard deviation of the noise at white."""
    dirt: Share = 0.0
    """How much dirt is on the lens."""


class Lidar(Part):
    """A spinning LiDAR, its axis upright over the vehicle."""

    position: tuple[float, float, float] = (0.9, 0.0, 1.95)
    """In the base frame."""
    beams: int = Field(default=32, ge=1, le=256)
    elevations: tuple[float, float] = (-25.0, 12.0)
    """Lowest and highest beam, degrees."""
    columns: int = Field(default=1000, ge=8, le=8192)
    """Measurements of each beam in a turn."""
    range: Positive = 120.0
    nearest: Positive = 1.5
    noise: float = Field(default=0.0, ge=0.0)
    """Standard deviation of distances, metres."""
    lost: Share = 0.0
    """Share of the measurements that are missing, besides those of the sky."""
    deskewed: bool = True
    """Whether points are moved to where the vehicle was at the sweep's stamp; else each is told from its own place."""


class Odometry(Part):
    """What the vehicle believes about its motion."""

    rate: Positive = 100.0
    """Messages per second."""
    scale: Positive = 1.0
    """Told by true distance."""
    noise: float = Field(default=0.0, ge=0.0)
    """Standard deviation of each message's distance as a share of it, and of its turn in radians per metre / 100."""
    yaw_drift: float = 0.0
    """Radians per second."""
    latency: float = Field(default=0.0, ge=0.0, le=5.0)
    """Seconds by which stamps are later than the motion that they tell."""


class Sensors(Part):
    """All sensors of a vehicle but the geometry of its cameras, which the rig file has."""

    rate: Positive = 10.0
    """Pictures per second of each camera, and turns of the LiDAR."""
    stagger: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.6
    """Share of the period over which the cameras fire one after another, in the order in which the LiDAR turns; 0: all
    at once."""
    readout: float = Field(default=0.0, ge=0.0, le=0.1)
    """Seconds from the first row to the last of a rolling shutter; the stamp is that of the middle row."""
    looks: tuple[CameraLook, ...] = (CameraLook(),)
    """Of each camera in the rig's order; the last one's is that of all further ones."""
    lidar: Lidar | None = Lidar()
    odometry: Odometry = Odometry()
    body: Literal["none", "car", "van", "robot"] = "none"
    """The vehicle's own body, below and between the cameras."""
    seed: int = 0
    """Of all noise."""

    def look(self, camera: int) -> CameraLook:
        """Return the look of a camera by its index in the rig."""
        return self.looks[min(camera, len(self.looks) - 1)]


def random_look(dice: Dice) -> CameraLook:
    """Think up a camera."""
    return CameraLook(
        key=dice.scale(0.17, 0.34),
        white_balance=(dice.scale(0.88, 1.14), 1.0, dice.scale(0.88, 1.14)),
        gamma=dice.between(1.9, 2.5),
        contrast=dice.between(0.88, 1.2),
        saturation=dice.between(0.65, 1.4),
        vignetting=round(dice.between(0.0, 0.75) ** 1.5, 2),
        bloom=max(0.0, dice.between(-0.3, 0.35)),
        blur=dice.between(0.0, 0.7),
        sharpening=max(0.0, dice.between(-0.5, 0.6)),
        noise=dice.scale(0.003, 0.035),
        dirt=max(0.0, dice.between(-1.2, 0.3)),
    )
