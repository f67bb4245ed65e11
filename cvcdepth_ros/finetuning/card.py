# SPDX-License-Identifier: Apache-2.0
"""The model card beside the weights: what they were made from, how, and how well they score."""

from __future__ import annotations

import hashlib
import html
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.files import nan_to_null, write_atomically, write_json
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.pose_network import pose_score_to_json
from cvcdepth_ros.bags import file_identities
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.finetuning.judgement import camera_numbers, numbers_of
from cvcdepth_ros.finetuning.run import FinetuneResult
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.sample_choice import describe_motion

CARD_FILE, CARD_TEXT_FILE = "model_card.json", "model_card.md"

SCORE_TITLES = {
    "abs_rel": "Abs Rel",
    "rmse": "RMSE (m)",
    "delta_1": "δ < 1.25",
    "scale": "scale",
    "photometric": "photometric error",
}
"""The titles of `camera_numbers` in tables."""


def model_card(result: FinetuneResult) -> dict[str, Any]:
    """Return the card's content, with JSON's types; docs/finetuning.md explains it."""
    job, trainer = result.job, result.trainer
    checkpoint = load_checkpoint(result.weights)
    configuration = job.config.model_dump(mode="json")
    return {
        "weights": {"file": result.weights.name, "sha256": checkpoint.sha256, "step": checkpoint.metadata.get("step")},
        "started_from": job.started_from,
        "promoted": result.verdict.promoted,
        "verdict": result.verdict.to_json(),
        "scores": {"before": _scores(result.before), "after": _scores(result.after)},
        "data": [_recording(result, i) for i in range(len(result.prepared.indexes))],
        "worlds": _worlds(result),
        "left_out": result.prepared.left_out,
        "warnings": result.prepared.warnings,
        "rigs": _rigs(result.prepared.indexes),
        "training": {
            "epochs": trainer.progress.epoch,
            "steps": trainer.progress.step,
            "skipped_steps": trainer.progress.skipped,
            "unreadable_batches": trainer.progress.unreadable,
            "ended_early": trainer.progress.stopped,
            "autocast": trainer.autocast,
        },
        "configuration": configuration,
        "configuration_sha256": hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest(),
        "version": package_version(),
        "made_with": {"torch": torch.__version__, "python": platform.python_version()},
    }


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write the card into `folder`, as JSON and as Markdown."""
    write_json(folder / CARD_FILE, dict(card))
    write_atomically(folder / CARD_TEXT_FILE, card_text(card).encode())


def card_text(card: Mapping[str, Any]) -> str:
    """Return the card as Markdown; whatever comes from files is escaped."""
    parts = (_head(card), _score_lines(card["scores"]), _world_lines(card), _data_lines(card), _how_lines(card))
    return "\n".join([*(line for part in parts for line in part), ""])


def score_pairs(
    before: Mapping[str, float | None], after: Mapping[str, float | None], arrow: str = " → ", unknown: str = "–"
) -> list[str]:
    """Return a cell `before → after` for each of `SCORE_TITLES`, of one camera's numbers."""
    pairs = [(before[name], after.get(name)) for name in SCORE_TITLES]
    return [arrow.join(unknown if number is None else f"{number:.3f}" for number in pair) for pair in pairs]


def pose_lines(scores: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the pose networks before and after say, and an empty line; nothing where no motion is recorded."""
    found = {when: (scores[when] or {}).get("pose_network") for when in ("before", "after")}
    told = [
        f"{one['ratio']:.2f} of the recorded way, {one['degrees']:.2f} degrees off, {when}"
        for when, one in found.items()
        if one and one["steps"]
    ]
    if told:
        yield f"The pose network tells {'; '.join(told)}."
        yield ""


def _scores(result: EvaluationResult | None) -> dict[str, Any] | None:
    if result is None:
        return None
    held_out, cameras = nan_to_null(numbers_of(result)), camera_numbers(result)
    return {"held_out": held_out, "cameras": cameras, "pose_network": pose_score_to_json(result.pose_score)}


def _worlds(result: FinetuneResult) -> dict[str, Any] | None:
    if result.general is None:
        return None
    found = None if result.on_worlds is None else result.on_worlds.to_json()
    if found is not None:
        found |= {part: nan_to_null(found[part]) for part in ("before", "after", "difference")}
    return {**result.general.to_json(), "scores": found}


def _recording(result: FinetuneResult, number: int) -> dict[str, Any]:
    index = result.prepared.indexes[number]
    first, last = (int(stamp) for stamp in index.stamps[[0, -1], index.anchor])
    try:
        files = [list(identity) for identity in file_identities(index.path)]
    except (CvcDepthError, OSError):
        files = []  # gone meanwhile
    return {
        "recording": str(index.path),
        "files": files,
        "from": _time(first),
        "seconds": (last - first) / NANOSECONDS,
        "sets": len(index),
        "outside_of_recorded_motion": index.without_motion,
        "training_samples": result.samples[number],
        "held_out_sets": _scored_sets(result, str(index.path)),
        "motion": describe_motion(index, result.job.config.recordings),
        "cameras": index.layout.names,
    }


def _scored_sets(result: FinetuneResult, path: str) -> int:
    """Return how many held-out sets of a recording were scored before and after; a part that failed proves nothing."""
    if result.before is None or result.after is None:
        return 0
    names = {part.job.name for part in result.parts if part.job.path == path}
    before, after = (
        {stamp for table in found.scores.images if table.recording in names for stamp in table.stamps_ns.tolist()}
        for found in (result.before, result.after)
    )
    return len(before & after)


def _rigs(indexes: Sequence[RecordingIndex]) -> list[dict[str, Any]]:
    rigs: list[dict[str, Any]] = []
    for index in indexes:
        rig = index.layout.model_dump(mode="json", exclude_defaults=True)
        if rig not in rigs:
            rigs.append(rig)
    return rigs


def _time(stamp: int) -> str:
    return datetime.fromtimestamp(stamp / NANOSECONDS, tz=timezone.utc).isoformat(timespec="seconds")


def _head(card: Mapping[str, Any]) -> Iterator[str]:
    weights = card["weights"]
    yield f"# Model card of {_plain(weights['file'])}"
    yield ""
    yield f"**{'Promoted' if card['promoted'] else 'Not promoted'}**: {_plain(card['verdict']['reason'])}."
    yield ""
    yield f"* Weights: `{_plain(weights['file'])}`, sha256 `{weights['sha256']}`, step {_plain(weights['step'])}"
    yield f"* Started from: {_plain(card['started_from'])}"
    yield f"* Made with cvcdepth_ros {card['version']}, torch {card['made_with']['torch']}"
    yield ""
    yield "Depth of every camera around a vehicle, learned without labels from the recordings below. It was tried on"
    yield "their last part only, which was not trained on: the same streets, weather and vehicle. Evaluate before use"
    yield "elsewhere."
    yield ""


def _score_lines(scores: Mapping[str, Any]) -> Iterator[str]:
    yield "## On the held-out part, before and after"
    yield ""
    before, after = scores["before"], scores["after"]
    if before is None or after is None:
        yield "Nothing was held out."
        return
    yield "| camera | " + " | ".join(SCORE_TITLES.values()) + " |"
    yield "|---|" + "---|" * len(SCORE_TITLES)
    for camera, numbers in before["cameras"].items():
        yield f"| {_plain(camera)} | " + " | ".join(score_pairs(numbers, after["cameras"].get(camera, {}))) + " |"
    yield ""
    yield "Scale is the median of median(truth) / median(prediction), 1 where depth is metric; the photometric error"
    yield "needs no labels. A dash stands for what could not be measured."
    yield ""
    yield from pose_lines(scores)


def _world_lines(card: Mapping[str, Any]) -> Iterator[str]:
    worlds = card["worlds"]
    if worlds is None:
        return
    yield "## Worlds"
    yield ""
    yield f"Beside the recordings, {worlds['views_per_step']} views of rendered worlds in each step, "
    yield f"{worlds['share']:.0%} of the pictures, of {_plain(worlds['drives'])}: {worlds['training_views']} views."
    if worlds["scores"] is not None:
        yield f"The weights are {_plain(worlds['scores']['verdict'])}."
    yield ""


def _data_lines(card: Mapping[str, Any]) -> Iterator[str]:
    yield "## Data"
    yield ""
    yield "| recording | from | seconds | sets | training samples | held-out sets | motion | cameras |"
    yield "|---|---|---|---|---|---|---|---|"
    for entry in card["data"]:
        counts = (entry["sets"], entry["training_samples"], entry["held_out_sets"], entry["motion"])
        cells = (entry["recording"], entry["from"], f"{entry['seconds']:.1f}", *counts, ", ".join(entry["cameras"]))
        yield f"| {' | '.join(_plain(cell) for cell in cells)} |"
    yield ""
    for reason in (*card["left_out"].values(), *card["warnings"]):
        yield f"* {_plain(reason)}"
    yield ""


def _how_lines(card: Mapping[str, Any]) -> Iterator[str]:
    training = card["training"]
    yield "## Training"
    yield ""
    counts = f"{training['epochs']} epochs, {training['steps']} steps, {training['skipped_steps']} of them skipped"
    yield f"{counts}; configuration (sha256 `{card['configuration_sha256']}`):"
    yield ""
    yield "```json"
    yield json.dumps(card["configuration"], indent=2)
    yield "```"


def _plain(value: object) -> str:
    """Return text that Markdown and HTML leave as it is, on one line."""
    escaped = html.escape(" ".join(str(value).split()), quote=False)
    return "".join(f"\\{letter}" if letter in "\\`*_[]|#" else letter for letter in escaped)
