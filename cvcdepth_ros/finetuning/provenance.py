# SPDX-License-Identifier: Apache-2.0
"""What a run is made from, in words and hashes: an interrupted run goes on with the same only."""

from __future__ import annotations

import hashlib

from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.finetuning.preparation import Prepared
from cvcdepth_ros.training_data.index import RecordingIndex

_DIGITS = 12


def inputs_of(prepared: Prepared, started_from: str) -> dict[str, str]:
    """Return start, recordings, rigs and masks by what each is called; a sample is known by its recording's place."""
    found = {"the start": started_from}
    for number, index in enumerate(prepared.indexes, 1):
        found[f"recording {number}"] = f"{index.path.name} ({_sets_digest(index)})"
        found[f"the rig of recording {number}"] = _rig_digest(index.layout)
        found[f"the masks of recording {number}"] = _masks(index.layout)
    return found


def _sets_digest(index: RecordingIndex) -> str:
    """Hash what images are found by; not the path, so that a copy of a recording is the same."""
    return _digest(index.stamps.tobytes() + index.log_times.tobytes())


def _rig_digest(layout: RigLayout) -> str:
    cameras = tuple(camera.model_copy(update={"mask": None}) for camera in layout.cameras)
    return _digest(layout.model_copy(update={"cameras": cameras}).model_dump_json().encode())


def _masks(layout: RigLayout) -> str:
    """Tell every mask by its content: a PNG may be painted over under the same name."""
    masks = {camera.name: camera.mask for camera in layout.cameras if camera.mask is not None}
    return ", ".join(f"{name} {_digest(mask.read_bytes())}" for name, mask in masks.items()) or "none"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
