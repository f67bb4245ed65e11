# SPDX-License-Identifier: Apache-2.0
"""Refine the held-out part of a recording every way there is, and score depth and confidence against its LiDAR.

    cvcdepth rig ../shared/data/pandaset_002 -o rig.yaml --masks
    python tools/refinement_trial.py ../shared/data/pandaset_002 --rig rig.yaml -o pictures/

Mounts are looked for in the part before (which the default model was trained on). Prints Markdown tables: mean over the
images of a camera, then over cameras, 0.5 to 80 m; what moves by itself is what the LiDAR does not see again in place.
CPU times are this process's, next to the network's in the same run. `--fit-confidence` prints the maps of
`refinement/confidence.py` instead, fitted to spoilt depth of the part before.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.surround import SurroundPreprocessor, to_tensor
from cvcdepth_core.model_choices import checkpoint_path
from cvcdepth_core.networks import PoseNet
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.refinement.alignment import Twist, exponential, logarithm
from cvcdepth_core.refinement.confidence import (
    RIGHT_WITHIN,
    SHIPPED_MAPS,
    ConfidenceMap,
    ConfidenceMaps,
    fit_confidence_map,
)
from cvcdepth_core.refinement.drive import DriveRefiner
from cvcdepth_core.refinement.moments import SurroundMoment
from cvcdepth_core.refinement.mounts import MountSearch, RefinedMounts
from cvcdepth_core.refinement.refiner import RefinedDepth, SurroundRefiner
from cvcdepth_core.refinement.settings import RefinementSettings
from cvcdepth_core.rendering.projection import axis_angle_to_rotation
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring.confidence import CalibrationTable, ConfidenceSamples, confidence_samples, sparsification
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import MeasuredSet, open_evaluation
from cvcdepth_ros.messages.conversion import picture_from_message

MIN_DEPTH, MAX_DEPTH = 0.5, 80.0
RANGES = ((0.5, 5), (5, 10), (10, 20), (20, 40), (40, 80))
TRUSTED = 0.65  # confidence of depth that mounts are looked for with
WARM_UP = 12  # sets before the held-out ones that fill the history
AROUND = (-10, -5, 5, 10)  # sets in which the LiDAR has to see a point again that stands still
SPOILT_SEED = 5
IDENTITY = ConfidenceMap((0.0, 1.0), (0.0, 1.0))


@dataclass(frozen=True, eq=False)
class TrialSet:
    """One recorded set, all that is known of it."""

    moment: SurroundMoment
    fine: SurroundMoment
    """The same with pictures of twice the size and the same depth, enlarged."""
    truth: Sequence[SparseDepth]
    parts: Sequence[PicturePart]
    """What of each camera's true picture the depth shows."""
    truth_intrinsics: Sequence[NDArray[np.float64]]
    """[3, 3] of each camera's true picture."""
    network_twist: Twist | None
    """The pose network's answer; None for the first set."""

    def sized(self, width: int) -> SurroundMoment:
        """Return the set with pictures that are at least so wide, where there are any."""
        return self.moment if width <= self.moment.depth.shape[2] else self.fine


class Recorded(NamedTuple):
    """A recording's sets."""

    rig: Rig
    sets: list[TrialSet]
    network_ms: float
    """CPU time of the depth network for one set."""

    @property
    def held_out(self) -> list[int]:
        """Numbers of the last quarter's sets."""
        return list(range(len(self.sets) * 3 // 4, len(self.sets)))


Standing = Mapping[int, Sequence[NDArray[np.bool_]]]
"""By the number of a set: of each camera's truth [M] whether it stands still."""
Result = list[tuple[int, RefinedDepth, float]]
"""Number of each set, what became of it, and CPU milliseconds."""


def main() -> None:
    """Print the tables."""
    options = parse_options()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    recorded = read(options.recording, options.rig)
    mounts = find_mounts(recorded)
    print_mounts(recorded.rig, mounts)
    if options.fit_confidence:
        print_confidence_maps(recorded, mounts)
        return
    still = {number: standing_points(recorded.sets, number) for number in recorded.held_out}
    print_scores(recorded, mounts, still, options)


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--rig", type=Path, help="rig file with masks of the vehicle [cameras found in the recording]")
    parser.add_argument(
        "--grids", type=int, nargs="+", default=[160, 320, 640], metavar="W", help="columns [%(default)s]"
    )
    parser.add_argument("--threads", type=int, default=1, help="of torch and OpenCV [1]")
    parser.add_argument("--fit-confidence", action="store_true", help="print confidence maps instead of scores")
    parser.add_argument("-o", "--output", type=Path, help="folder for pictures of every third held-out set")
    return parser.parse_args()


# Reading.


def read(path: str, rig: Path | None) -> Recorded:
    """Estimate all sets with the package's own model, and collect truth, motion and the pose network's answers."""
    settings = EvaluationSettings(min_depth=MIN_DEPTH, max_depth=MAX_DEPTH)
    job = EvaluationJob("trial", path, settings, load_rig_layout(rig) if rig else None)
    sets: list[TrialSet] = []
    pose_network = load_pose_network()
    with open_evaluation(job) as evaluation:
        measured = list(evaluation.sets(*evaluation.window))
        built = measured[0].estimated.rig
        height, width = measured[0].estimated.result.depth.shape[1:]
        usual, fine = (SurroundPreprocessor(built, scale * height, scale * width) for scale in (1, 2))
        anchor = built.names.index(built.anchor)
        for one in measured:
            moment = taken(one, usual, one.estimated.result.pictures)
            larger = taken(one, fine, fine_pictures(one, fine))
            twist = network_twist(pose_network, sets[-1].moment, moment, anchor) if sets else None
            views = [camera.rectified_view.intrinsics for camera in built.cameras]
            sets.append(TrialSet(moment, larger, one.truth, one.parts, views, twist))
        estimator = evaluation.depths.estimator
        first = sets[0].moment
        surround = SurroundPictures(first.pictures, first.present, first.intrinsics, first.base_T_camera, first.valid)
        network_ms = cpu_ms(lambda: estimator.estimate(surround), 7)
    return Recorded(built, sets, network_ms)


def taken(measured: MeasuredSet, preprocessor: SurroundPreprocessor, pictures: NDArray[np.uint8]) -> SurroundMoment:
    """Put a measured set together, its depth enlarged to the pictures' size."""
    rig, images = measured.estimated.rig, measured.estimated.surround_set
    return SurroundMoment(
        depth=enlarged_depth(measured.estimated.result.depth, pictures.shape[2]),
        pictures=pictures,
        present=measured.estimated.result.present,
        intrinsics=preprocessor.intrinsics,
        valid=preprocessor.valid,
        base_T_camera=np.stack([camera.base_T_camera for camera in rig.cameras]),
        times_ns=np.array([images.times_ns[name] for name in rig.names]),
        world_T_base=None if measured.world_T_base is None else np.stack(measured.world_T_base),
    )


def fine_pictures(measured: MeasuredSet, preprocessor: SurroundPreprocessor) -> NDArray[np.uint8]:
    """Decode and rectify the set's images once more, larger."""
    pictures: list[Picture] = []
    for name, rectifier in preprocessor.rectifiers.items():
        message = measured.estimated.surround_set.images[name].message
        picture = picture_from_message(message, name, rectifier.reduction, rectifier.image_size)
        pictures.append(rectifier(picture, name, rectifier.reduction))
    return np.stack(pictures)


def enlarged_depth(depth: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Interpolate inverse depth over what is known of [N, H, W]; unknown stays what is mostly unknown."""
    scale = width // depth.shape[2]
    if scale == 1:
        return depth
    known = (~np.isnan(depth)).astype(np.float32)
    nearness = np.where(known > 0, 1 / depth, 0).astype(np.float32)
    size = (width, depth.shape[1] * scale)
    shares, sums = (np.stack([cv2.resize(x, size) for x in stack]) for stack in (known, nearness))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(shares > 0.5, shares / sums, np.nan).astype(np.float32)


def load_pose_network() -> PoseNet:
    """Load the default model's."""
    checkpoint = load_checkpoint(checkpoint_path(""))
    network = PoseNet(checkpoint.spec.encoder)
    network.load_state_dict(checkpoint.pose_net)
    return network.eval()


def network_twist(network: PoseNet, earlier: SurroundMoment, later: SurroundMoment, anchor: int) -> Twist:
    """Return the base frame's motion as the pose network sees it in the anchor's pictures."""
    with torch.inference_mode():
        frames = [to_tensor([moment.pictures[anchor]])[None] for moment in (earlier, later)]
        axis_angle, translation = network(*frames)
    later_T_earlier = np.eye(4)
    later_T_earlier[:3, :3] = axis_angle_to_rotation(axis_angle[0]).numpy()
    later_T_earlier[:3, 3] = translation[0].numpy()
    base_T_camera = later.base_T_camera[anchor]
    in_base = base_T_camera @ inverse(later_T_earlier) @ inverse(base_T_camera)
    return logarithm(in_base) / float((later.times_ns - earlier.times_ns)[anchor] / 1e9)


def cpu_ms(work: Callable[[], object], rounds: int) -> float:
    """Return the median CPU time of this process for the work, in milliseconds."""
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - began))
    return statistics.median(spent)


# Refining.


def find_mounts(recorded: Recorded) -> RefinedMounts:
    """Search in every second set of the second quarter to the held-out part, by depth that motion alone has refined."""
    pairs = recorded.rig.neighbour_indices
    refiner = SurroundRefiner(pairs, RefinementSettings(max_grid_width=320, use_neighbours=False))
    search = MountSearch(pairs, recorded.rig.names.index(recorded.rig.anchor))
    end = recorded.held_out[0]
    for number, one in enumerate(recorded.sets[:end]):
        refined = refiner.refine(one.moment)
        if number >= end // 2 and number % 2 == 1:
            search.add(one.moment, np.where(refined.confidence > TRUSTED, refined.depth, np.nan))
    return search.result()


def refine_all(
    recorded: Recorded, grid: int, motion: str, mounts: NDArray[np.float64] | None, prior: list | None = None
) -> Result:
    """Refine the held-out sets, after those that fill the history.

    `motion` is odometry, alignment or network; neighbours: odometry places the exposures, but nothing earlier is looked
    at, as after standing for a while; unknown: nothing places them.
    """
    first = recorded.held_out[0] if prior is None else len(recorded.sets) // 3
    numbers = range(max(0, first - WARM_UP), len(recorded.sets) if prior is None else recorded.held_out[0])
    settings = RefinementSettings(max_grid_width=grid)
    settings = replace(settings, distances=()) if motion == "neighbours" else settings
    maps = SHIPPED_MAPS if prior is None else ConfidenceMaps(IDENTITY, IDENTITY)
    refiner = SurroundRefiner(recorded.rig.neighbour_indices, settings, confidence_maps=maps)
    aligning = DriveRefiner(recorded.rig.neighbour_indices, settings) if motion == "alignment" else None
    poses = network_poses(recorded.sets) if motion == "network" else None
    found = []
    for number in numbers:
        moment = recorded.sets[number].sized(grid)
        moment = moment if mounts is None else replace(moment, base_T_camera=mounts)
        moment = moment if prior is None else moment.with_depth(prior[number])
        if motion not in ("odometry", "neighbours"):
            moment = replace(moment, world_T_base=None if poses is None else poses[number])
        began = time.process_time()
        refined = refiner.refine(moment) if aligning is None else aligning.refine(moment).depth
        found.append((number, refined, 1e3 * (time.process_time() - began)))
    return [one for one in found if one[0] >= first]


def network_poses(sets: Sequence[TrialSet]) -> list[NDArray[np.float64] | None]:
    """Chain the pose network's motions to world_T_base [N, 4, 4] of every set; None for the first."""
    here: Pose = np.eye(4)
    poses: list[NDArray[np.float64] | None] = [None]
    for before, one in pairwise(sets):
        seconds = one.moment.times_ns / 1e9
        twist = np.zeros(6) if one.network_twist is None else one.network_twist
        here = here @ exponential(twist * float(seconds.mean() - before.moment.times_ns.mean() / 1e9))
        poses.append(np.stack([here @ exponential(twist * float(s - seconds.mean())) for s in seconds]))
    return poses


# Scoring.


def standing_points(sets: Sequence[TrialSet], number: int) -> list[NDArray[np.bool_]]:
    """Return of each camera's truth [M] whether the LiDAR sees the point again, in place, before or after."""
    clouds = {n: world_points(sets[n]) for n in (number + step for step in AROUND) if 0 <= n < len(sets)}
    own = world_points(sets[number])
    distance = [truth.depth for truth in sets[number].truth]
    standing = []
    for points, depth in zip(own, distance, strict=True):
        again = {n: seen_in(points, depth, np.concatenate(cloud)) for n, cloud in clouds.items()}
        before = [seen for n, seen in again.items() if n < number]
        after = [seen for n, seen in again.items() if n > number]
        either = [np.all(side, axis=0) for side in (before, after) if side]
        standing.append(np.any(either, axis=0) if either else np.ones(len(points), bool))
    return standing


def world_points(one: TrialSet) -> list[NDArray[np.float64]]:
    """Return each camera's true points [M, 3] in the world."""
    moment = one.moment
    found = []
    for truth, K, pose in zip(one.truth, one.truth_intrinsics, moment.camera_poses, strict=True):
        pixels = np.stack([truth.columns, truth.rows, np.ones(len(truth))], axis=1) @ np.linalg.inv(K).T
        found.append(pixels * truth.depth[:, None] @ pose[:3, :3].T + pose[:3, 3])
    return found


def seen_in(points: NDArray[np.float64], depth: NDArray[np.float64], cloud: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points [M] have one of the cloud in their cube or one beside it; cubes grow with the distance."""
    seen = np.zeros(len(points), bool)
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 3)
    for near, far, edge in ((0, 10, 0.25), (10, 20, 0.35), (20, 40, 0.6), (40, np.inf, 1.0)):
        chosen = np.flatnonzero((depth >= near) & (depth < far))
        filled = np.unique(cube_numbers(np.floor(cloud / edge)))
        cubes = np.floor(points[chosen] / edge)
        for step in steps:
            seen[chosen] |= np.isin(cube_numbers(cubes + step), filled)
    return seen


def cube_numbers(cubes: NDArray[np.float64]) -> NDArray[np.int64]:
    """Give each cube [M, 3] a number."""
    x, y, z = (cubes.astype(np.int64) + 2**20).T
    return (x << 42) | (y << 21) | z


class Scores(NamedTuple):
    """Means over images, then cameras."""

    abs_rel: float
    median: float
    delta: float
    by_camera: NDArray[np.float64]
    by_range: NDArray[np.float64]
    standing: float
    moving: float
    ause: float
    surest_half: float
    calibration: float


def scored(recorded: Recorded, still: Standing, result: Result, of_prior: bool) -> Scores:
    """Score refined depth and its confidence, or the depth before with the confidence it then has."""
    rows, table = [], CalibrationTable.empty()
    for number, refined, _ in result:
        one = recorded.sets[number]
        depth = one.sized(refined.depth.shape[2]).depth if of_prior else refined.depth
        confidence = refined.prior_confidence if of_prior else refined.confidence
        for camera, truth in enumerate(one.truth):
            stands = still[number][camera]
            samples, standing, moving = (
                confidence_samples(depth[camera], confidence[camera], found, MIN_DEPTH, MAX_DEPTH, one.parts[camera])
                for found in (truth, truth[stands], truth[~stands])
            )
            rows.append(image_row(camera, samples, standing, moving))
            table = table + CalibrationTable.from_samples(samples)
    cameras = np.stack([nanmean([row[1:] for row in rows if row[0] == c]) for c in range(len(recorded.rig.cameras))])
    means = nanmean(cameras)
    return Scores(*means[:3], cameras[:, 0], means[7:], *means[3:7], table.expected_error)


def image_row(camera: int, samples: ConfidenceSamples, *parts: ConfidenceSamples) -> list[float]:
    """Return camera, Abs Rel, median, delta, Abs Rel of both parts, AUSE, surest half, Abs Rel by range."""
    error = np.abs(samples.prediction - samples.truth) / samples.truth
    right = np.abs(np.log(samples.prediction / samples.truth)) < RIGHT_WITHIN
    ranked = sparsification(samples)
    by_part = [mean_or_nan(np.abs(part.prediction - part.truth) / part.truth) for part in parts]
    by_range = [mean_or_nan(error[(samples.truth >= a) & (samples.truth < b)]) for a, b in RANGES]
    median = float(np.median(error)) if error.size else np.nan
    return [
        camera,
        mean_or_nan(error),
        median,
        mean_or_nan(right),
        *by_part,
        ranked.ause,
        ranked.surest_half,
        *by_range,
    ]


def mean_or_nan(values: NDArray[np.generic]) -> float:
    """Return the mean; NaN for nothing."""
    return float(values.mean()) if values.size else np.nan


def nanmean(rows: Sequence[Sequence[float]] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each column, NaN left out."""
    values = np.array(rows, dtype=np.float64)
    known = ~np.isnan(values)
    return np.where(known.any(0), np.nansum(values, 0) / np.maximum(known.sum(0), 1), np.nan)


# Telling.


def print_mounts(rig: Rig, mounts: RefinedMounts) -> None:
    """Print what was found of each pair, and each camera's correction."""
    print("| pair | patches | ZNCC before | after | turn x, y, z (degrees) | |\n|---|---|---|---|---|---|")
    for pair in mounts.pairs:
        names = f"{rig.names[pair.camera]} in {rig.names[pair.neighbour]}"
        turn = " ".join(f"{angle:+.2f}" for angle in pair.turn)
        print(f"| {names} | {pair.patches} | {pair.before:.2f} | {pair.after:.2f} | {turn} | {pair.problem or ''} |")
    print("\n| camera | correction x, y, z (degrees) | |\n|---|---|---|")
    for name, turn in zip(rig.names, mounts.turns, strict=True):
        print(f"| {name} | {' '.join(f'{angle:+.2f}' for angle in turn)} | {np.linalg.norm(turn):.2f} |")
    print()


def trials(options: argparse.Namespace, mounts: RefinedMounts) -> Iterator[tuple[str, int, str, NDArray | None]]:
    """Give name, grid, motion and mounts of every trial."""
    for grid in options.grids:
        shown = f"{grid * 3 // 5}x{grid}"
        yield f"{shown}, neighbours only", grid, "neighbours", None
        yield f"{shown}, neighbours only, refined mounts", grid, "neighbours", mounts.base_T_camera
        yield f"{shown}, motion unknown, refined mounts", grid, "unknown", mounts.base_T_camera
        yield f"{shown}, odometry", grid, "odometry", None
        yield f"{shown}, odometry, refined mounts", grid, "odometry", mounts.base_T_camera
        yield f"{shown}, alignment, refined mounts", grid, "alignment", mounts.base_T_camera
        yield f"{shown}, pose network, refined mounts", grid, "network", mounts.base_T_camera


def print_scores(recorded: Recorded, mounts: RefinedMounts, still: Standing, options: argparse.Namespace) -> None:
    """Print a row for the depth as it is and for every trial."""
    cameras, ranges = " | ".join(recorded.rig.names), " | ".join(f"{a:g}-{b:g} m" for a, b in RANGES)
    columns = (
        f"| | Abs Rel | median | delta | {cameras} | {ranges} | standing | moving | AUSE | surest half | calibration"
    )
    print(f"{columns} | CPU ms | x network |\n|{'---|' * (columns.count('|') + 2)}")
    print_row(
        "as it is", scored(recorded, still, refine_all(recorded, 160, "odometry", None), of_prior=True), None, 0.0
    )
    for name, grid, motion, given in trials(options, mounts):
        result = refine_all(recorded, grid, motion, given)
        spent = statistics.median(ms for _, _, ms in result)
        print_row(name, scored(recorded, still, result, of_prior=False), spent, recorded.network_ms)
        if options.output and given is not None and motion == "odometry":
            save_pictures(recorded, result, options.output, grid)
    print(f"\nThe network takes {recorded.network_ms:.0f} ms of CPU time for a set.")


def print_row(name: str, scores: Scores, spent_ms: float | None, network_ms: float) -> None:
    """Print one line of the table."""
    numbers = [*scores[:3], *scores.by_camera, *scores.by_range, *scores[5:]]
    cost = "| |" if spent_ms is None else f"| {spent_ms:.0f} | {spent_ms / network_ms:.2f} |"
    print(f"| {name} | {' | '.join(f'{number:.3f}' for number in numbers)} {cost}", flush=True)


def save_pictures(recorded: Recorded, result: Result, folder: Path, grid: int) -> None:
    """Draw every third set: picture, depth before, after, log ratio, confidence; a row for each camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, refined, _ in result[::3]:
        moment = recorded.sets[number].sized(grid)
        rows = []
        for camera, picture in enumerate(moment.pictures):
            before, after = moment.depth[camera], refined.depth[camera]
            maps = [coloured(-np.log(before), -4.1, -0.4), coloured(-np.log(after), -4.1, -0.4)]
            maps += [coloured(np.log(after / before), -0.8, 0.8), coloured(refined.confidence[camera], 0, 1)]
            rows.append(np.concatenate([picture[..., ::-1], *maps], axis=1))
        cv2.imwrite(str(folder / f"set_{number:03d}_grid_{grid}.png"), np.concatenate(rows))


def coloured(values: NDArray[np.floating], least: float, most: float) -> NDArray[np.uint8]:
    """Colour [H, W] values by OpenCV's turbo, unknown ones black."""
    scaled = np.nan_to_num(255 * (np.clip(values, least, most) - least) / (most - least)).astype(np.uint8)
    colours = np.asarray(cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO))
    colours[np.isnan(values)] = 0
    return colours


def print_confidence_maps(recorded: Recorded, mounts: RefinedMounts) -> None:
    """Fit the maps to spoilt depth of the part before the held-out one, on two grids together; print their knots."""
    prior = [spoilt(one.moment.depth, SPOILT_SEED + number) for number, one in enumerate(recorded.sets)]
    found: dict[str, list[ConfidenceSamples]] = {"REFINED_CONFIDENCE": [], "PRIOR_CONFIDENCE": []}
    for grid in (160, 320):
        for number, refined, _ in refine_all(recorded, grid, "odometry", mounts.base_T_camera, prior):
            for camera, truth in enumerate(recorded.sets[number].truth):
                pairs = ((refined.depth, refined.confidence), (prior[number], refined.prior_confidence))
                for samples, (depth, raw) in zip(found.values(), pairs, strict=True):
                    part = recorded.sets[number].parts[camera]
                    samples.append(confidence_samples(depth[camera], raw[camera], truth, MIN_DEPTH, MAX_DEPTH, part))
    for name, samples in found.items():
        raw = np.concatenate([s.confidence for s in samples])
        right = np.concatenate([np.abs(np.log(s.prediction / s.truth)) < RIGHT_WITHIN for s in samples])
        fitted = fit_confidence_map(raw[raw > 0], right[raw > 0], knots=16)
        print(name, [round(x, 3) for x in fitted.raw], [round(x, 3) for x in fitted.probability])


def spoilt(depth: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    """Make depth [N, H, W] as bad as that of a set never seen: blurred, times smooth random factors."""
    random = np.random.default_rng(seed)
    found = np.empty_like(depth)
    for camera, metres in enumerate(depth):
        unknown = np.isnan(metres)
        logs = cv2.GaussianBlur(np.where(unknown, np.nanmedian(np.log(metres)), np.log(metres)), (0, 0), 5)
        coarse = random.normal(size=(5, 7)).astype(np.float32)
        factors = cv2.resize(coarse, (metres.shape[1], metres.shape[0]), interpolation=cv2.INTER_CUBIC)
        spoiled = np.exp(logs + 0.18 * factors + 0.1 * random.normal())
        found[camera] = np.where(unknown, np.nan, spoiled)
    return found


if __name__ == "__main__":
    main()
