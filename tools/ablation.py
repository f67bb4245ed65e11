# SPDX-License-Identifier: Apache-2.0
"""Train the paper's ablation on a recording, several seeds each, and write the table of held-out scores.

python tools/ablation.py drive/ --rig rig.yaml --config config/training/ablation_recording.yaml \
    --from imagenet.safetensors -o runs/ablation --table docs/ablation_table.md

Variants differ from CONFIG in what config/training/ablation/ says of objective and augmentation; `--encoder NAME` adds
a run of everything with that encoder, from random weights. Killed, it goes on where it stood; finished runs stay.
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

import cv2
import torch

from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.config import TrainingConfig, load_training_config
from cvcdepth_core.training.run_folder import CHECKPOINT_FILE
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import Trainer
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import RecordingIndex, load_index
from cvcdepth_ros.training_data.loader import RecordingBatches
from cvcdepth_ros.training_data.sample_choice import first_held_out

PUBLISHED = Path(__file__).parent.parent / "config" / "training" / "ablation"
VARIANTS = {
    "front pose only": "front_pose.yaml",
    "+ DDCL": "front_pose_ddcl.yaml",
    "+ MVRCL": "front_pose_mvrcl.yaml",
    "+ Hflip-S": "front_pose_hflip.yaml",
    "all": "../ddad_r18.yaml",
}


class Run(NamedTuple):
    """One training run of the ablation."""

    variant: str
    seed: int
    config: TrainingConfig
    folder: Path


def main() -> None:
    """Train what is not trained yet, evaluate all, write the table."""
    options = parse_options()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    layout = load_rig_layout(options.rig) if options.rig else None
    runs = list(planned_runs(options))
    index = load_index(options.recording, options.output / "index", MatchingSettings.model_validate({}), layout)
    for run in runs:
        train(run, [index], None if run.variant in options.encoder else options.start)
        print(f"{run.variant}, seed {run.seed}: trained", flush=True)
    scores = {run: evaluate(run, index, options) for run in runs}
    options.table.write_text(table(runs, scores), encoding="utf-8")
    print(options.table.read_text(encoding="utf-8"))


def planned_runs(options: argparse.Namespace) -> Iterator[Run]:
    """Give the runs, seed by seed, so that an interrupted ablation has whole rows of few seeds."""
    base = load_training_config(options.config)
    for seed in range(options.seeds):
        for variant, file in VARIANTS.items():
            published = load_training_config(PUBLISHED / file)
            changes = {"objective": published.objective, "augmentation": published.augmentation, "seed": seed}
            yield planned_run(variant, seed, base.model_copy(update=changes), options.output)
        for encoder in options.encoder:
            depth = base.depth.model_copy(update={"encoder": encoder})
            pose = base.pose.model_copy(update={"encoder": encoder})
            config = base.model_copy(update={"depth": depth, "pose": pose, "seed": seed})
            yield planned_run(encoder, seed, config, options.output)


def planned_run(variant: str, seed: int, config: TrainingConfig, output: Path) -> Run:
    """Name the run's folder after variant and seed."""
    name = variant.replace("+ ", "").replace(" ", "_").lower()
    return Run(variant, seed, config, output / f"{name}-{seed}")


def train(run: Run, indexes: Sequence[RecordingIndex], start: Path | None) -> None:
    """Train to the configured end; nothing happens where that is reached."""
    model = build_surround_model(run.config, load_checkpoint(start) if start else None)
    Trainer(run.config, model, RecordingBatches(indexes, run.config), run.folder).train(quiet=True)


def evaluate(run: Run, index: RecordingIndex, options: argparse.Namespace) -> dict[str, Any]:
    """Score the held-out part with the bag tool, as a user would; return what metrics.json says."""
    with open_recording(index.path) as recording:
        first = index.log_times[first_held_out(index, run.config.recordings.held_out)].min()
        start = (int(first) - recording.start) / NANOSECONDS
    command = [sys.executable, "-m", "cvcdepth_ros.bag_replay", "evaluate", str(index.path), "--quiet", "--no-report"]
    command += ["--checkpoint", str(run.folder / CHECKPOINT_FILE), "--start", f"{start:.6f}"]
    command += ["-o", str(run.folder / "scores"), *(["--rig", str(options.rig)] if options.rig else [])]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    found: dict[str, Any] = json.loads((run.folder / "scores" / "metrics.json").read_text(encoding="utf-8"))
    return found


def table(runs: Sequence[Run], scores: Mapping[Run, Mapping[str, Any]]) -> str:
    """Return a Markdown table: mean and spread over the seeds of each variant."""
    lines = ["| variant | Abs Rel | per seed | median-scaled Abs Rel | scale ratio |", "|---|---|---|---|---|"]
    for variant in dict.fromkeys(run.variant for run in runs):
        of_variant = [summary(scores[run]) for run in runs if run.variant == variant]
        abs_rel, scaled, ratio = ([row[i] for row in of_variant] for i in range(3))
        seeds = " ".join(f"{value:.3f}" for value in abs_rel)
        lines.append(f"| {variant} | {spread(abs_rel)} | {seeds} | {spread(scaled)} | {spread(ratio)} |")
    return "\n".join(lines) + "\n"


def spread(values: Sequence[float]) -> str:
    """Return mean and standard deviation."""
    return f"{mean(values):.3f} ± {stdev(values):.3f}" if len(values) > 1 else f"{values[0]:.3f}"


def summary(metrics: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return scale-aware Abs Rel, median-scaled Abs Rel and the scale ratio, means over the cameras."""
    image = metrics["scores"]["image"]
    metric, scaled = (image[kind]["mean"]["all"] for kind in ("metric", "median"))
    ratio = geometric_mean(metrics["scale_ratio"]["image"].values())
    return metric["abs_rel"], scaled["abs_rel"], ratio


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path, help="rig file [the cameras found in the recording]")
    parser.add_argument("--config", type=Path, required=True, help="what all runs have in common")
    parser.add_argument(
        "--from", dest="start", type=Path, required=True, help="checkpoint that the variants start from"
    )
    parser.add_argument("--encoder", action="append", default=[], help="also train this encoder, from random weights")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each variant [3]")
    parser.add_argument("--threads", type=int, default=1, help="of torch and OpenCV [1]")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--table", type=Path, required=True, help="Markdown table to write")
    return parser.parse_args()


if __name__ == "__main__":
    main()
