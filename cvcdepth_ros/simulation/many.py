# SPDX-License-Identifier: Apache-2.0
"""Many short drives, each with a rig and world of its own, as shards for training. No ROS here."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from cvcdepth_core.errors import ConfigError, OutputError, RigError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.worlds.drive import DriveSpec
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.sensors import Sensors
from cvcdepth_core.worlds.shards import SUFFIX, PictureForm, write_shard
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.simulation.choices import LookChoice, chosen_layout, chosen_sensors, chosen_world
from cvcdepth_ros.simulation.workers import run_all

_RECIPE = "recipe.json"
_CAR_HEIGHT = 1.1  # metres: lower cameras are those of robots
_ATTEMPTS = 8  # seeds that are tried for a drive: now and then a vehicle would start inside of something


class ManyDrives(NamedTuple):
    """What all drives have in common."""

    drives: int
    rig: str
    """As for `simulate`."""
    world: str
    size: tuple[int, int] | None
    seed: int
    seconds: float
    rate: float
    samples: int
    look: LookChoice
    body: str
    """none, car, van, robot; or varied: none for about half of the drives."""
    stagger: float | None
    readout: float
    images: PictureForm
    quality: int


def simulate_many(
    choices: ManyDrives, folder: Path, workers: int, progress: Callable[[int], None] = lambda _: None
) -> dict[str, Any]:
    """Write one shard for each drive into `folder`; those that are there already are not done again.

    Raises ConfigError if the folder was begun with other choices. Returns the recipe.
    """
    recipe = {"version": package_version(), **choices._asdict()}
    _keep_recipe(folder, recipe)
    missing = [number for number in range(choices.drives) if not shard_path(folder, number).exists()]
    done = choices.drives - len(missing)
    progress(done)
    for _ in run_all(missing, _Job(choices, folder).work, workers):
        done += 1
        progress(done)
    return recipe


def shard_path(folder: Path, number: int) -> Path:
    """Return the file of a drive."""
    return folder / f"drive_{number:06d}{SUFFIX}"


def _keep_recipe(folder: Path, recipe: dict[str, Any]) -> None:
    """Write down what was chosen; the number of drives may grow, all else must be as it was."""
    path = folder / _RECIPE
    content = json.loads(json.dumps(recipe))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        begun = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
    except (OSError, ValueError) as error:
        raise OutputError(f"{folder}: cannot be used: {error}") from error
    if begun is not None and begun | {"drives": 0} != content | {"drives": 0}:
        changed = sorted(key for key in content if key != "drives" and begun.get(key) != content[key])
        raise ConfigError(f"{folder}: begun with another {', '.join(changed)}; choose another folder")
    write_atomically(path, f"{json.dumps(content, indent=1)}\n".encode())


class _Job:
    """What a worker process is told."""

    def __init__(self, choices: ManyDrives, folder: Path) -> None:
        self.choices = choices
        self.folder = folder

    def work(self, number: int) -> None:
        """Write one shard, with the first seed that gives a possible drive."""
        for attempt in range(_ATTEMPTS):
            try:
                spec = drive_spec(self.choices, number, attempt)
                write_shard(shard_path(self.folder, number), spec, self.choices.images, self.choices.quality)
            except (ConfigError, RigError):
                if attempt + 1 == _ATTEMPTS:
                    raise
            else:
                return


def drive_spec(choices: ManyDrives, number: int, attempt: int = 0) -> DriveSpec:
    """Return the description of one of many drives."""
    dice = Dice(choices.seed, number, attempt, 401)
    seed = dice.whole(0, 2**31 - 1)
    layout = chosen_layout(choices.rig, choices.size, seed)
    sensors = chosen_sensors(len(layout.cameras), choices.look, "exact", seed)
    body = choices.body
    if body == "varied":
        high = min(camera.base_T_camera[2, 3] for camera in layout.complete().cameras) > _CAR_HEIGHT
        body = dice.weighted({"none": 0.42, "car": 0.48, "van": 0.1} if high else {"none": 0.6, "robot": 0.4})
    stagger = dice.between(0.0, 0.9) if choices.stagger is None else choices.stagger
    changes = {"rate": choices.rate, "stagger": stagger, "readout": choices.readout, "body": body, "lidar": None}
    return DriveSpec(
        layout=layout,
        world=chosen_world(choices.world, seed, choices.seconds),
        sensors=Sensors.model_validate(sensors.model_dump() | changes),
        seconds=choices.seconds,
        samples=choices.samples,
    )
