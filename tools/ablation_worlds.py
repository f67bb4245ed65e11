# SPDX-License-Identifier: Apache-2.0
"""The paper's ablation on many simulated drives of a rig like DDAD's, scored by exact depth on drives of other seeds.

    cvcdepth import efficientnet-lite0-*.pth --config ablation_worlds -o imagenet.safetensors
    make ablation OUT=runs/ablation_worlds FROM=imagenet.safetensors

Simulates the drives (random worlds, moving traffic, all cameras at once), trains every row of config/training/ablation/
with several seeds, and writes OUT/table.md: dense depth in all of the pictures and in the overlaps, means and
deviations over the seeds, and the difference to the front camera's pose alone with its interval over the held-out
drives. One process; killed at any moment, the same command goes on where it stood, and --only-table writes the table of
what is there.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import geometric_mean

import cv2
import numpy as np
import torch
from ablation import PUBLISHED, Run, planned_run, spread, train
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.scoring.comparison import SetValues, compare_values, set_metrics
from cvcdepth_core.scoring.metrics import METRIC_NAMES
from cvcdepth_core.scoring.scores import ALL, OVERLAP, Scaling, Scores
from cvcdepth_core.training.config import TrainingConfig, load_training_config
from cvcdepth_core.training.run_folder import CHECKPOINT_FILE
from cvcdepth_core.worlds.drive import DriveSpec, SimulatedDrive
from cvcdepth_core.worlds.generation.kinds import WorldKind
from cvcdepth_core.worlds.generation.random_world import random_world
from cvcdepth_core.worlds.sensors import CameraLook, Sensors
from cvcdepth_core.worlds.trajectories import SpeedProfile
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import evaluate_recording
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.simulation.choices import chosen_layout
from cvcdepth_ros.simulation.recording import record
from cvcdepth_ros.simulation.set_messages import Form, recorded_layout
from cvcdepth_ros.training_data.index import RecordingIndex, load_index

SHIPPED = PUBLISHED.parent / "ablation_worlds.yaml"
REFERENCE = "front pose (d)"
ROWS = {
    REFERENCE: "front_pose.yaml",
    "all": "../ddad_r18.yaml",
    "+ DDCL": "front_pose_ddcl.yaml",
    "+ DDCL as a share (ours)": "front_pose_ddcl.yaml",
    "+ MVRCL": "front_pose_mvrcl.yaml",
    "+ Hflip-S of both": "front_pose_hflip.yaml",
    "FSM baseline (a)": "fsm_baseline.yaml",
    "joint pose (b)": "joint_pose.yaml",
    "joint front pose (c)": "joint_front_pose.yaml",
    "+ DCL": "front_pose_dcl.yaml",
    "+ Hflip-S of depth": "front_pose_hflip_depth.yaml",
    "+ Hflip-S of pose": "front_pose_hflip_pose.yaml",
}
"""In the order in which they are trained: what an interrupted ablation has first says most."""
# At the truth of a rendered drive the term in metres is about 14, the share 0.05: the same part of the loss.
CHANGES = {"+ DDCL as a share (ours)": {"depth_difference": "share", "depth_consistency": 0.2}}
"""What rows that are not the paper's change of their file's objective."""
KINDS: tuple[WorldKind, ...] = ("city", "suburb", "rural", "industrial", "highway", "square", "forest")
RATE = 10.0
LEAST_SPEED = 2.0  # metres per second; slower drives teach nothing
HELD_OUT_SEED = 1_000_000
ATTEMPTS = 20


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, train and score what is not there yet; write the table after every run."""
    options = parse_options(arguments)
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    runs = list(planned_runs(options))
    if not options.only_table:
        config = load_training_config(options.config)
        drives = simulated(options.output / "drives", 0, options.drives, options.sets, config)
        held_out = simulated(options.output / "held_out", HELD_OUT_SEED, options.held_out, 3, config)
        indexes = indexed(drives, options.output / "index")
        for run in runs:
            print(f"{run.variant}, seed {run.seed}", flush=True)
            train(run, indexes, options.start)
            score(run, held_out, config.evaluation.max_depth)
            write_table(options.output / "table.md", runs)
    write_table(options.output / "table.md", runs)
    print((options.output / "table.md").read_text(encoding="utf-8"))


def planned_runs(options: argparse.Namespace) -> Iterator[Run]:
    """Give the runs, seed by seed, so that an interrupted ablation has whole rows of few seeds."""
    base = load_training_config(options.config)
    for seed in range(options.seeds):
        for variant in options.rows or ROWS:
            row = load_training_config(PUBLISHED / ROWS[variant])
            pose = base.pose.model_copy(update={"method": row.pose.method})
            objective = row.objective.model_copy(update=CHANGES.get(variant, {}))
            changes = {"objective": objective, "augmentation": row.augmentation, "pose": pose, "seed": seed}
            yield planned_run(variant, seed, base.model_copy(update=changes), options.output / "runs")


# Drives.


def simulated(folder: Path, first_seed: int, count: int, sets: int, config: TrainingConfig) -> list[Path]:
    """Record the drives that are not there yet; each is of the first seed of its own that moves."""
    for number in range(count):
        path = folder / f"drive_{number:03d}"
        if not path.exists():
            spec = possible_drive(first_seed + 1000 * number, number, sets, (config.depth.width, config.depth.height))
            record(spec, Form(images="png"), path)
            print(f"{path}: {spec.world.name}", flush=True)
    return [folder / f"drive_{number:03d}" for number in range(count)]


def possible_drive(seed: int, number: int, sets: int, size: tuple[int, int]) -> DriveSpec:
    """Return a drive that moves from set to set and does not begin inside of something."""
    for attempt in range(ATTEMPTS):
        spec = drive_spec(seed + attempt, KINDS[number % len(KINDS)], sets, size)
        speeds = SpeedProfile(spec.world.drive.speeds).speed(np.array([spec.set_time(n) for n in range(sets)]))
        if np.abs(speeds).min() < LEAST_SPEED:
            continue
        try:
            SimulatedDrive(spec)
        except ConfigError:  # it begins inside of something
            continue
        return spec
    raise ConfigError(f"seeds {seed} to {seed + ATTEMPTS - 1}: no drive is faster than {LEAST_SPEED} m/s")


def drive_spec(seed: int, kind: WorldKind, sets: int, size: tuple[int, int]) -> DriveSpec:
    """Return a drive of the DDAD-like rig by day; cameras as alike as DDAD's, with a little noise."""
    seconds = sets / RATE
    world = random_world(seed, kind, seconds)
    if world.sky.weather in ("dusk", "night"):
        world = world.model_copy(
            update={"sky": world.sky.model_copy(update={"weather": "cloudy", "sun_elevation": 30})}
        )
    sensors = Sensors(rate=RATE, stagger=0.0, lidar=None, seed=seed, looks=(CameraLook(noise=0.005),))
    layout = recorded_layout(chosen_layout("ddad", size, seed), "png")
    return DriveSpec(layout=layout, world=world, sensors=sensors, seconds=seconds)


def indexed(drives: Sequence[Path], folder: Path) -> list[RecordingIndex]:
    """Read the drives once, or what was kept of that."""
    return [load_index(str(drive), folder, MatchingSettings()) for drive in drives]


# Scores.


def scores_path(run: Run) -> Path:
    """Where a finished run's scores lie."""
    return run.folder / "scores.json"


def score(run: Run, drives: Sequence[Path], max_depth: float) -> None:
    """Score a run on the held-out drives by their depth images, as `evaluate --truth depth` does."""
    if scores_path(run).exists():
        return
    checkpoint = str(run.folder / CHECKPOINT_FILE)
    settings = EvaluationSettings(truth="depth", checkpoint=checkpoint, max_depth=max_depth, backend="torch")
    found = [evaluate_recording(EvaluationJob(drive.name, str(drive), settings)).scores for drive in drives]
    write_atomically(scores_path(run), json.dumps(Scores.merged(found).to_json()).encode())


def read_scores(runs: Sequence[Run]) -> dict[str, list[Scores]]:
    """Return the scores of all finished runs, by row."""
    found: dict[str, list[Scores]] = {}
    for run in runs:
        if scores_path(run).exists():
            content = json.loads(scores_path(run).read_text(encoding="utf-8"))
            found.setdefault(run.variant, []).append(Scores.from_json(content))
    return found


def of_drives(seeds: Sequence[Scores], scaling: Scaling, group: str) -> SetValues:
    """Return the metrics of each drive: means over its sets, and over the seeds."""
    found: dict[tuple[str, int], list[NDArray[np.float64]]] = {}
    for scores in seeds:
        for (drive, _), values in set_metrics(scores, scores.cameras, scaling, group).items():
            found.setdefault((drive, 0), []).append(values)
    return {drive: nan_mean(np.stack(values)) for drive, values in found.items()}


def nan_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over the first axis of what is known; NaN where nothing is."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        mean: NDArray[np.float64] = np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0)
    return mean


# The table.


def write_table(path: Path, runs: Sequence[Run]) -> None:
    """Write the Markdown table of all that is finished."""
    write_atomically(path, table(read_scores(runs)).encode())


COLUMNS: Mapping[str, tuple[Scaling, str]] = {
    "Abs Rel": ("metric", ALL),
    "in overlaps": ("metric", OVERLAP),
    "median-scaled": ("median", ALL),
}


def table(found: Mapping[str, Sequence[Scores]]) -> str:
    """Return a line for each row: means over the seeds, and the difference to the reference over the drives."""
    names = [part for name in COLUMNS for part in (name, "difference")]
    heading = ["row", "seeds", *names, "scale ratio", "DDAD, published"]
    lines = [f"| {' | '.join(heading)} |", "|---" * len(heading) + "|"]
    for variant, seeds in found.items():
        cells = [variant, str(len(seeds))]
        for scaling, group in COLUMNS.values():
            cells += [spread([abs_rel(scores, scaling, group) for scores in seeds])]
            cells += [difference(found, variant, scaling, group)]
        cells += [spread([geometric_mean(scores.scale_ratios().values()) for scores in seeds])]
        lines.append(f"| {' | '.join([*cells, published(variant)])} |")
    return "\n".join(lines) + "\n"


def abs_rel(scores: Scores, scaling: Scaling, group: str) -> float:
    """Return the mean over images, then cameras."""
    return scores.summary("image", scaling).mean[group].metrics["abs_rel"]


def difference(found: Mapping[str, Sequence[Scores]], variant: str, scaling: Scaling, group: str) -> str:
    """Return the row's difference to the reference and its 95 % interval over drives; bold where 0 is outside."""
    if variant == REFERENCE or REFERENCE not in found:
        return ""
    # Seeds that only one of the two has would tell of the seeds.
    seeds = min(len(found[variant]), len(found[REFERENCE]))
    first, second = (of_drives(found[name][:seeds], scaling, group) for name in (REFERENCE, variant))
    compared = compare_values(first, second, METRIC_NAMES, block=1).differences["abs_rel"]
    text = f"{compared.difference:+.3f} ({compared.low:+.3f} to {compared.high:+.3f})"
    return f"**{text}**" if compared.low > 0 or compared.high < 0 else text


def published(variant: str) -> str:
    """Return the paper's Abs Rel on DDAD, which the row's file tells; that of all is in docs/method.md."""
    if variant in CHANGES:
        return ""
    told = re.search(r"Abs Rel (0\.\d+)", (PUBLISHED / ROWS[variant]).read_text(encoding="utf-8"))
    return told.group(1) if told else "0.210"


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder of drives, runs, table")
    parser.add_argument("--from", dest="start", type=Path, help="checkpoint that all runs start from [random weights]")
    parser.add_argument("--config", type=Path, default=SHIPPED, help="what all runs have in common [%(default)s]")
    parser.add_argument("--rows", nargs="+", choices=ROWS, metavar="ROW", help=f"[all: {', '.join(ROWS)}]")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each row [3]")
    parser.add_argument("--drives", type=int, default=40, help="that are trained on [40]")
    parser.add_argument("--sets", type=int, default=8, help="of each drive, at 10 Hz [8]")
    parser.add_argument("--held-out", type=int, default=20, help="drives that are scored, of three sets each [20]")
    parser.add_argument("--threads", type=int, default=1, help="of torch and OpenCV [1]")
    parser.add_argument("--only-table", action="store_true", help="write the table of what is finished")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
