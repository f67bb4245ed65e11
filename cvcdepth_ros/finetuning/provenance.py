# SPDX-License-Identifier: Apache-2.0
"""The inputs of a run, by name and hash (an interrupted run goes on with the same only), and what its weights know."""

from __future__ import annotations

import hashlib

from cvcdepth_core.networks.checkpoint import Checkpoint
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.evaluation.trained_on import TrainedPart, trained_parts
from cvcdepth_ros.finetuning.preparation import Prepared
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.sample_choice import first_held_out

_DIGITS = 12


def trained_on(prepared: Prepared, held_out: float, start: Checkpoint | None) -> list[TrainedPart]:
    """Return what the run's weights will have learned from, that of their start included."""
    parts = trained_parts(start)
    for index in prepared.indexes:
        stamps = index.stamps[: first_held_out(index, held_out), index.anchor]
        if len(stamps):
            parts.append(TrainedPart.from_stamps(index.path.name, stamps))
    return parts


def inputs_of(prepared: Prepared, started_from: str) -> dict[str, str]:
    """Return start, recordings, rigs and masks, each by a name; samples are known by their recording's place."""
    found = {"the start": started_from}
    for number, index in enumerate(prepared.indexes, 1):
        found[f"recording {number}"] = f"{index.path.name} ({_sets_digest(index)})"
        found[f"the rig of recording {number}"] = _rig_digest(index.layout)
        found[f"the masks of recording {number}"] = _masks(index.layout)
    return found


def _sets_digest(index: RecordingIndex) -> str:
    """Return a hash of the stamps by which images are found; not of the path, so that a copy is the same."""
    return _digest(index.stamps.tobytes() + index.log_times.tobytes())


def _rig_digest(layout: RigLayout) -> str:
    cameras = tuple(camera.model_copy(update={"mask": None}) for camera in layout.cameras)
    told = {"cameras": cameras, "ground_height": layout.ground_z}
    return _digest(layout.model_copy(update=told).model_dump_json().encode())


def _masks(layout: RigLayout) -> str:
    """Return the cameras' masks with hashes of their content: a PNG may be painted over under the same name."""
    masks = {camera.name: camera.mask for camera in layout.cameras if camera.mask is not None}
    return ", ".join(f"{name} {_digest(mask.read_bytes())}" for name, mask in masks.items()) or "none"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
