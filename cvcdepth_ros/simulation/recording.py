# SPDX-License-Identifier: Apache-2.0
"""A simulated drive as a rosbag2 recording: set by set in several processes, then put together. No ROS here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from heapq import merge
from pathlib import Path
from typing import Any

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.files import write_json
from cvcdepth_core.rig.rig_file import save_rig_layout
from cvcdepth_core.worlds.drive import DriveSpec, SimulatedDrive
from cvcdepth_core.worlds.world_file import save_world
from cvcdepth_ros.bags import RecordingWriter
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.simulation.parts import Parts
from cvcdepth_ros.simulation.set_messages import Form, Stored, motion_messages, set_messages, static_transforms
from cvcdepth_ros.simulation.workers import run_all

RESULT_FILE, RIG_FILE, WORLD_FILE = "simulation.json", "rig.yaml", "world.yaml"
Progress = Callable[[int], None]
"""Called with the number of finished sets."""


def record(
    spec: DriveSpec, form: Form, output: Path, workers: int = 1, progress: Progress = lambda _: None
) -> dict[str, Any]:
    """Simulate a drive into a new rosbag2 folder `output`, with its rig file, its world file and a JSON of all choices.

    Sets that an interrupted run of the same drive finished are not done again. The result is the same to the byte for
    any number of workers. Returns the content of the JSON.
    """
    if output.exists():
        raise RecordingError(f"{output}: exists already, will not be overwritten")
    parts = Parts(output, _recipe(spec, form))
    missing = [number for number in range(spec.sets) if not parts.has(number)]
    done = spec.sets - len(missing)
    progress(done)
    job = _Job(spec, form, output)
    for _ in run_all(missing, job.work, workers, job.prepare):
        done += 1
        progress(done)
    result = _write(spec, form, output, parts)
    parts.remove()
    return result


class _Job:
    """What a worker process is told."""

    def __init__(self, spec: DriveSpec, form: Form, output: Path) -> None:
        self.spec = spec
        self.form = form
        self.output = output

    def prepare(self) -> None:
        """Build the world, so that the first set is as quick as the others."""
        _drive(self.spec)

    def work(self, number: int) -> None:
        """Finish one set."""
        parts = Parts(self.output, _recipe(self.spec, self.form))
        parts.save(number, set_messages(_drive(self.spec), number, self.form))


@functools.lru_cache(maxsize=1)
def _drive_of(key: str) -> SimulatedDrive:
    return SimulatedDrive(DriveSpec.model_validate_json(key))


def _drive(spec: DriveSpec) -> SimulatedDrive:
    """Return the drive of this process, built once."""
    return _drive_of(spec.model_dump_json())


def _recipe(spec: DriveSpec, form: Form) -> dict[str, Any]:
    return {"version": package_version(), **form._asdict(), "drive": spec.model_dump(mode="json")}


def _write(spec: DriveSpec, form: Form, output: Path, parts: Parts) -> dict[str, Any]:
    drive = _drive(spec)
    counts: dict[str, int] = {}
    # Depth is worth packing; what JPEG has packed costs little more.
    with RecordingWriter(output, compress=form.truth != "none") as writer:
        sets = (message for number in range(spec.sets) for message in parts.load(number))
        for message in merge([static_transforms(spec)], motion_messages(drive), sets, key=_time):
            if message.topic not in counts:
                writer.add_topic(message.topic, message.type)
            counts[message.topic] = counts.get(message.topic, 0) + 1
            writer.write(message.topic, message.log_time, message.cdr)
    header = f"Written by simulate {package_version()}."
    save_rig_layout(output / RIG_FILE, spec.layout, header)
    save_world(output / WORLD_FILE, spec.world, header)
    result = _result(drive, form, counts)
    write_json(output / RESULT_FILE, result)
    return result


def _time(message: Stored) -> tuple[int, str]:
    return message.log_time, message.topic


def _result(drive: SimulatedDrive, form: Form, counts: dict[str, int]) -> dict[str, Any]:
    spec = drive.spec
    configuration = spec.model_dump(mode="json", exclude={"layout", "world"})
    return {
        "version": package_version(),
        "world": {"name": spec.world.name, "kind": spec.world.kind, "seed": spec.world.seed, "file": WORLD_FILE},
        "rig": RIG_FILE,
        "configuration": {**configuration, **form._asdict()},
        "sets": spec.sets,
        "messages": dict(sorted(counts.items())),
        "triangles": len(drive.world.mesh.faces),
        "objects": list(drive.world.names),
    }
