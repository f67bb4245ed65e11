# SPDX-License-Identifier: Apache-2.0
"""From a few words to a whole drive: which rig, which world, which sensors. No ROS here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast, get_args

import yaml
from pydantic import ValidationError

from cvcdepth_core.errors import ConfigError, RigError, first_validation_message
from cvcdepth_core.files import load_yaml
from cvcdepth_core.rig.rig_file import RigLayout, load_rig_layout
from cvcdepth_core.worlds.description import WorldSpec
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.kinds import WorldKind
from cvcdepth_core.worlds.generation.random_rig import random_rig
from cvcdepth_core.worlds.generation.random_world import random_world
from cvcdepth_core.worlds.rig_size import complete_layout, layout_at_size
from cvcdepth_core.worlds.sensors import CameraLook, Odometry, Sensors, random_look
from cvcdepth_core.worlds.world_file import load_world
from cvcdepth_ros.installation import share_directory

KNOWN_RIGS = ("ddad", "nuscenes", "pandaset")
RANDOM = "random"
_USUAL_WIDTH = 480  # pixels
OdometryChoice = Literal["exact", "wheels"]
LookChoice = Literal["clean", "varied"]
_WHEELS = Odometry(scale=1.01, noise=0.05, yaw_drift=0.001, latency=0.01)


def chosen_layout(rig: str, size: tuple[int, int] | None, seed: int) -> RigLayout:
    """Return the rig of a file, one like a data set's, or a random one, with pictures of `size` (width, height).

    Its base frame lies on the ground, as in every world: where a file's lies elsewhere, it is moved there. Without a
    size, pictures are 480 pixels wide and keep their shape.
    RigError names the file and the camera that lacks its calibration or mount.
    """
    if rig == RANDOM:
        return _on_ground(layout_at_size(random_rig(seed), size, _USUAL_WIDTH))
    path = share_directory() / "config" / "rigs" / "simulated" / f"{rig}.yaml" if rig in KNOWN_RIGS else Path(rig)
    layout = complete_layout(load_rig_layout(path), f"rig file {path}")
    return _on_ground(layout_at_size(layout, size, _USUAL_WIDTH))


def _on_ground(layout: RigLayout) -> RigLayout:
    """Return the rig with its base frame on the ground, and its cameras as high above that as they are."""
    cameras = []
    for camera in layout.cameras:
        if camera.base_T_camera is None:
            raise RigError(f"camera {camera.name}: no base_T_camera")
        x, y, z = camera.base_T_camera.translation
        raised = camera.base_T_camera.model_copy(update={"translation": (x, y, z - layout.ground_z)})
        cameras.append(camera.model_copy(update={"base_T_camera": raised}))
    return layout.model_copy(update={"cameras": tuple(cameras), "ground_height": 0.0})


def chosen_world(world: str, seed: int, seconds: float) -> WorldSpec:
    """Return the world of a file, of a seed, or of a kind of place; ConfigError lists the kinds."""
    if world.isdecimal():
        return random_world(int(world), None, seconds)
    if world == RANDOM:
        return random_world(seed, None, seconds)
    if world in get_args(WorldKind):
        return random_world(seed, cast(WorldKind, world), seconds)
    if Path(world).suffix in (".yaml", ".yml") or Path(world).exists():
        return load_world(Path(world))
    raise ConfigError(
        f"world {world}: neither a file, nor a seed, nor a kind of place; kinds are {', '.join(get_args(WorldKind))}"
    )


def chosen_sensors(cameras: int, look: LookChoice, odometry: OdometryChoice, seed: int) -> Sensors:
    """Return sensors whose cameras are ideal (clean) or each a little different (varied)."""
    sensors = Sensors(seed=seed, odometry=Odometry() if odometry == "exact" else _WHEELS)
    if look == "clean":
        return sensors
    return sensors.model_copy(update={"looks": _varied_looks(cameras, seed)})


def _varied_looks(cameras: int, seed: int) -> Sequence[CameraLook]:
    """Return looks of one maker's cameras, which differ by a few per cent."""
    dice = Dice(seed, 307)
    common = random_look(dice)
    return tuple(
        common.model_copy(
            update={
                "key": round(common.key * dice.scale(0.92, 1.09), 4),
                "dirt": max(0.0, common.dirt + dice.normal(0.1)),
            }
        )
        for _ in range(cameras)
    )


def load_sensors(path: Path) -> Sensors:
    """Read a file of sensors. ConfigError names the file, the field and the value that is wrong."""
    try:
        return Sensors.model_validate(load_yaml(path.read_text(encoding="utf-8")) or {})
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"sensors file {path}: cannot be read: {' '.join(str(error).split())}") from error
    except ValidationError as error:
        raise ConfigError(f"sensors file {path}: {first_validation_message(error)}") from error
