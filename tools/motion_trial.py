# SPDX-License-Identifier: Apache-2.0
"""Fine-tune a model on a recording with the recorded motion and with the pose network's, several seeds each.

    cvcdepth rig ../shared/data/pandaset_002 -o rig.yaml --masks
    python tools/motion_trial.py ../shared/data/pandaset_002 --rig rig.yaml -o runs/motion --epochs 8

Every run is `finetune --from default` on the first three quarters, with as many steps, and is scored by `evaluate` on
the held-out quarter; so is the start. `--other-rig FILE` adds runs with recorded motion and another rig file's mounts,
which are scored with `--rig` as the others. Killed, it goes on where it stood; finished runs stay.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import geometric_mean, mean, stdev
from typing import Any, NamedTuple

import yaml

from cvcdepth_core.training.run_folder import CHECKPOINT_FILE

PROMOTED, NOT_PROMOTED = 0, 3
FAR = ("20-40", "40-80")
SHIPPED = Path(__file__).parent.parent / "config" / "training" / "finetune.yaml"


class Arm(NamedTuple):
    """One way to fine-tune."""

    name: str
    motion: str
    """`recordings.motion`."""
    rig: Path | None


class Row(NamedTuple):
    """What is told of one checkpoint."""

    abs_rel: float
    far: float
    """Abs Rel from 20 to 80 m, the two bins' points together."""
    scale: float
    """True over predicted median depth, geometric mean over cameras."""
    pose_ratio: float
    pose_degrees: float


def main() -> None:
    """Train what is not trained yet, score all, print the table."""
    options = parse_options()
    arms = list(planned_arms(options))
    rows: dict[str, list[Row]] = {"start": [scored(options, "default", options.output / "start")]}
    for seed in range(options.seeds):
        for arm in arms:
            folder = options.output / f"{arm.name.replace(' ', '_')}-{seed}"
            train(options, arm, seed, folder)
            rows.setdefault(arm.name, []).append(scored(options, str(folder / CHECKPOINT_FILE), folder / "held_out"))
            print(f"{arm.name}, seed {seed}: {rows[arm.name][-1]}", flush=True)
    print(table(rows))


def planned_arms(options: argparse.Namespace) -> Iterator[Arm]:
    """Give the ways to fine-tune."""
    yield Arm("network's motion", "network", options.rig)
    yield Arm("recorded motion", "recorded", options.rig)
    if options.other_rig:
        yield Arm("recorded motion, other mounts", "recorded", options.other_rig)


def train(options: argparse.Namespace, arm: Arm, seed: int, folder: Path) -> None:
    """Fine-tune to the configured end; nothing happens where that is reached."""
    if (folder / "finetune.json").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    config = folder / "training.yaml"
    config.write_text(yaml.safe_dump(training_file(options, arm, seed)), encoding="utf-8")
    start = ["--from", "default", "--config", str(config), "--skip", "places"]
    command("finetune", options.recording, arm.rig, *start, "-o", str(folder), allowed=(PROMOTED, NOT_PROMOTED))


def training_file(options: argparse.Namespace, arm: Arm, seed: int) -> dict[str, Any]:
    """Return the content of a run's training file."""
    return {
        "base": str(options.config.resolve()),
        "recordings": {"motion": arm.motion},
        "optimizer": {"epochs": options.epochs, "decay_after_epochs": options.epochs, "autocast": "auto"},
        "evaluation": {"sets": 2},  # all are scored at the end, and nothing is chosen by them
        "validate_every": options.epochs,
        "seed": seed,
    }


def scored(options: argparse.Namespace, checkpoint: str, folder: Path) -> Row:
    """Score a checkpoint on the held-out quarter, as a user would; what is there is not done again."""
    metrics = folder / "metrics.json"
    if not metrics.exists():
        window = ["--start", f"{options.start:g}", "--min-depth", "0.5", "--no-report"]
        command("evaluate", options.recording, options.rig, "--checkpoint", checkpoint, *window, "-o", str(folder))
    return row(json.loads(metrics.read_text(encoding="utf-8")))


def command(name: str, recording: str, rig: Path | None, *options: str, allowed: Sequence[int] = (PROMOTED,)) -> None:
    """Run one of `cvcdepth`'s commands; CalledProcessError where it ends with another code than those allowed."""
    rig_options = ["--rig", str(rig)] if rig else []
    line = [sys.executable, "-m", "cvcdepth_ros.bag_replay", name, recording, *rig_options, *options, "--quiet"]
    code = subprocess.run(line, check=False, stdout=subprocess.DEVNULL).returncode
    if code not in allowed:
        raise subprocess.CalledProcessError(code, line)


def row(metrics: Mapping[str, Any]) -> Row:
    """Return the numbers of a metrics.json."""
    image = metrics["scores"]["image"]["metric"]["mean"]
    pose = metrics["pose_network"]
    scale = geometric_mean(metrics["scale_ratio"]["image"].values())
    return Row(image["all"]["abs_rel"], far(image), scale, pose["ratio"], pose["degrees"])


def far(of_ranges: Mapping[str, Mapping[str, float]]) -> float:
    """Return the mean of the far ranges, weighted by their points."""
    bins = [of_ranges[name] for name in FAR]
    points = [one["truth_points"] for one in bins]
    return sum(one["abs_rel"] * count for one, count in zip(bins, points, strict=True)) / sum(points)


def table(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return a Markdown table: mean and spread over the seeds."""
    lines = ["| | Abs Rel | 20 to 80 m | scale | pose ratio | degrees |", "|---|---|---|---|---|---|"]
    for name, found in rows.items():
        lines.append(f"| {name} | {' | '.join(map(spread, zip(*found, strict=True)))} |")
    return "\n".join(lines)


def spread(values: Sequence[float]) -> str:
    """Return mean and standard deviation."""
    return f"{mean(values):.3f} ± {stdev(values):.3f}" if len(values) > 1 else f"{values[0]:.3f}"


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--rig", type=Path, help="rig file, for training and scores [the cameras found]")
    parser.add_argument("--other-rig", type=Path, help="rig file with other mounts, for further runs")
    parser.add_argument("--config", type=Path, default=SHIPPED, help="what all runs have in common [finetune.yaml]")
    parser.add_argument("--epochs", type=int, default=8, help="of each run [8]")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each way [3]")
    parser.add_argument("--start", type=float, default=2.93, help="second at which the held-out sets begin [2.93]")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the runs")
    return parser.parse_args()


if __name__ == "__main__":
    main()
