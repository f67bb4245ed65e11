# SPDX-License-Identifier: Apache-2.0
"""What to expect of a checkpoint on a rig that it has not seen: the tables of docs/default_model.md.

    python tools/unseen_rigs.py model.safetensors --worlds heldout/* --street pandaset_002 --rig rig.yaml --start 3 -o o

Simulated drives (`simulate --truth all`) are scored by their depth, the street by its LiDAR: as they are; the street
shown by other rigs (views of the same pictures, with calibration and poses that fit them); and with a network that is
told its rig wrongly, or sees other weather, while truth stays where it is. One process and one thread; `rows.jsonl`
keeps what is done, so that the same command goes on where it was killed. Of the first set of each there is a picture:
the cameras, the network's depth, the truth; red is 1 m, dark blue 80.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import geometric_mean, mean
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.estimator import DepthEstimator, SurroundDepthEstimator
from cvcdepth_core.model_choices import checkpoint_path
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout, load_rig_layout
from cvcdepth_core.rig.view import Aspect, PicturePart
from cvcdepth_core.scoring.metrics import median_ratio, sum_errors
from cvcdepth_core.scoring.obstacles import ObstacleScorer, ObstacleScores
from cvcdepth_core.scoring.references import best_constant
from cvcdepth_core.scoring.scorer import DepthSamples
from cvcdepth_core.scoring.sky import SkyCounts
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_core.visualization import DepthScale
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import MeasuredSet, RecordingEvaluation
from cvcdepth_ros.recordings.rig import RecordedRig

WORLDS, STREET, SHOWN, TOLD = "worlds", "street", "shown", "told"
MIN_DEPTH, MAX_DEPTH = 0.5, 80.0
LEAST_POINTS = 50  # of an image that is scored

Change = Callable[[SurroundPictures, np.random.Generator], SurroundPictures]
Row = dict[str, Any]


class Scene(NamedTuple):
    """A recording, read once."""

    name: str
    cameras: list[str]
    sets: list[MeasuredSet]
    valid: NDArray[np.bool_]
    """[N, H, W] of every set."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] above the ground."""


class Source(NamedTuple):
    """A recording, and how it is read."""

    kind: str
    path: str
    layout: RigLayout | None
    start: float
    every: int

    @property
    def name(self) -> str:
        """The folder's name."""
        return Path(self.path).name

    @property
    def job(self) -> EvaluationJob:
        """What is evaluated."""
        truth = "depth" if self.kind == WORLDS else "lidar"
        fields = {"min_depth": MIN_DEPTH, "max_depth": MAX_DEPTH, "tolerance": 0.2, "truth": truth}
        settings = EvaluationSettings.model_validate(fields)
        return EvaluationJob(self.name, self.path, settings, self.layout, start=self.start)


def main() -> None:
    """Score what is not scored yet, and print the tables."""
    options = parse_options()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    estimator = DepthEstimator.from_checkpoint(checkpoint_path(options.checkpoint), "cpu")
    options.output.mkdir(parents=True, exist_ok=True)
    kept = Rows(options.output / "rows.jsonl", estimator.weights_id)
    for source in sources(options):
        score_source(source, estimator, kept)
    tables = "\n\n".join(markdown(kept.rows))
    (options.output / "tables.md").write_text(tables + "\n", encoding="utf-8")
    print(tables)


class Rows:
    """What was scored before, of the same weights; a line each in a file."""

    def __init__(self, path: Path, weights: str) -> None:
        self._path, self._weights = path, weights
        self.folder = path.parent
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.rows: list[Row] = [row for row in map(json.loads, lines) if row["weights"] == weights]

    def has(self, recording: str, part: str, case: str) -> bool:
        """Whether this was scored."""
        wanted = (recording, part, case)
        return any((row["recording"], row["part"], row["case"]) == wanted for row in self.rows)

    def add(self, recording: str, part: str, case: str, found: Row) -> None:
        """Keep one more."""
        row = {"weights": self._weights, "recording": recording, "part": part, "case": case, **found}
        self.rows.append(row)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps({key: row[key] for key in row if key != "weights"}), flush=True)


def score_source(source: Source, estimator: DepthEstimator, kept: Rows) -> None:
    """Score a recording as it is, with what is told or seen changed, and the street as other rigs show it."""
    told = [case for case in cases_of(estimator) if not kept.has(source.name, TOLD, case)]
    if told or not kept.has(source.name, source.kind, AS_IT_IS):
        scene = read(source, estimator)
        if not kept.has(source.name, source.kind, AS_IT_IS):
            draw(scene, kept.folder / f"{source.name}.jpg")
            kept.add(source.name, source.kind, AS_IT_IS, scored(scene, estimator, unchanged))
        for case in told:
            kept.add(source.name, TOLD, case, scored(scene, estimator, CHANGES[case]))
    for case, shown in SHOWN_BY.items() if source.kind == STREET else ():
        if not kept.has(source.name, SHOWN, case):
            picture = kept.folder / f"{source.name}_{list(SHOWN_BY).index(case) + 1}.jpg"
            kept.add(source.name, SHOWN, case, scored_as_shown(source, estimator, shown, picture))


def scored_as_shown(source: Source, estimator: DepthEstimator, shown: Shown, picture: Path) -> Row:
    """Score the recording as another rig shows it, or say why the rig is refused."""
    with open_recording(source.path) as recording:
        layout = RecordedRig.from_recording(recording, source.layout).completed().layout
    other = source._replace(layout=shown_by(layout, shown))
    try:
        scene = read(other, estimator)
        draw(scene, picture)
        return scored(scene, estimator, unchanged)
    except CvcDepthError as error:
        return {"refused": str(error)}


def read(source: Source, estimator: DepthEstimator) -> Scene:
    """Read a recording's sets with their truth; the errors of the family say what is wrong with it."""
    with open_recording(source.path) as recording:
        recorded = RecordedRig.from_recording(recording, source.layout)
        evaluation = RecordingEvaluation(source.job, recorded, estimator)
        sets = list(evaluation.sets(*evaluation.window))[:: source.every]
        rig = evaluation.replay.rig
    surround = SurroundDepthEstimator(rig, estimator)
    return Scene(source.name, rig.names, sets, surround.preprocessor.valid, rig.poses_above_ground)


def scored(scene: Scene, estimator: DepthEstimator, change: Change) -> Row:
    """Score the network on every set after a change: means over images, then over cameras."""
    images: dict[str, list[Row]] = {name: [] for name in scene.cameras}
    sky, obstacles = SkyCounts(), ObstacleScorer()
    for number, known in enumerate(scene.sets):
        measured = estimated_anew(known, scene, estimator, change, np.random.default_rng(number))
        for name, samples in zip(scene.cameras, measured.samples(), strict=True):
            images[name] += image_scores(samples)
        sky += measured.sky(MAX_DEPTH)
        estimated = measured.estimated
        obstacles.add(estimated.result, estimated.rig, measured.truth, None, measured.stamp_ns)
    return joined(images, sky, obstacles.scores())


def estimated_anew(
    measured: MeasuredSet, scene: Scene, estimator: DepthEstimator, change: Change, random: np.random.Generator
) -> MeasuredSet:
    """Return the set with the network's depth after a change; its truth stays."""
    result = measured.estimated.result
    shown = SurroundPictures(result.pictures, result.present, result.intrinsics, scene.base_T_camera, scene.valid)
    changed = change(shown, random)
    found = estimator.estimate(changed)
    known = scene.valid & result.present[:, None, None]
    depth, sky = np.where(known, found, np.float32(np.nan)), estimator.sky(changed, found) & known
    return replace(measured, estimated=replace(measured.estimated, result=replace(result, depth=depth, sky=sky)))


def image_scores(samples: DepthSamples) -> list[Row]:
    """Return the scores of one image as one row, or none where it has too little truth."""
    inside = (samples.truth > MIN_DEPTH) & (samples.truth < MAX_DEPTH) & ~np.isnan(samples.prediction)
    truth, prediction = samples.truth[inside], np.clip(samples.prediction[inside], MIN_DEPTH, MAX_DEPTH)
    if len(truth) < LEAST_POINTS:
        return []
    errors = sum_errors(prediction, truth)
    constant = sum_errors(np.full(len(truth), best_constant(truth)), truth)
    return [
        {
            "abs_rel": errors.abs_rel / len(truth),
            "delta": errors.delta_1 / len(truth),
            "constant": constant.abs_rel / len(truth),
            "scale": median_ratio(prediction, truth),
        }
    ]


def joined(images: dict[str, list[Row]], sky: SkyCounts, obstacles: ObstacleScores) -> Row:
    """Return one row of all cameras."""
    cameras = {
        name: {key: mean(row[key] for row in rows) for key in rows[0]} | {"scale": median_of(rows, "scale")}
        for name, rows in images.items()
        if rows
    }
    of_all = {key: mean(row[key] for row in cameras.values()) for key in ("abs_rel", "delta", "constant")}
    worst = max(cameras, key=lambda name: cameras[name]["abs_rel"])
    return {
        **of_all,
        "scale": geometric_mean(row["scale"] for row in cameras.values()),
        "worst": [worst, cameras[worst]["abs_rel"]],
        "better": [sum(row["abs_rel"] < row["constant"] for row in cameras.values()), len(cameras)],
        "sky_iou": sky.iou,
        "recall": float(obstacles.recall()[0, -1]),
        "precision": float(obstacles.precision()[0, -1]),
        "images": sum(map(len, images.values())),
    }


def median_of(rows: Sequence[Row], key: str) -> float:
    """Return the median of a column."""
    return float(np.median([row[key] for row in rows]))


def draw(scene: Scene, path: Path) -> None:
    """Write the cameras' pictures of the first set, the network's depth and the truth."""
    measured = scene.sets[0]
    result = measured.estimated.result
    truth = [near_points(*each, *result.depth.shape[1:]) for each in zip(measured.truth, measured.parts, strict=True)]
    scale = DepthScale()
    rows = [result.pictures, scale.colours(result.depth), scale.colours(np.stack(truth))]
    sheet = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    cv2.imwrite(str(path), sheet[..., ::-1])


def near_points(truth: SparseDepth, part: PicturePart, height: int, width: int) -> NDArray[np.float32]:
    """Return truth [H, W] in the network's picture: the nearest of the points in and beside each pixel."""
    rows = np.floor((truth.rows + 0.5 - part.top) * height / part.height).astype(np.int64)
    columns = np.floor((truth.columns + 0.5 - part.left) * width / part.width).astype(np.int64)
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    nearness = np.zeros((height, width), np.float32)
    np.maximum.at(nearness, (rows[inside], columns[inside]), (1 / truth.depth[inside]).astype(np.float32))
    grown = cv2.dilate(nearness, np.ones((3, 3), np.uint8))
    with np.errstate(divide="ignore"):
        return np.where(grown > 0, 1 / grown, np.nan).astype(np.float32)


# What the network is told, or sees.


def unchanged(pictures: SurroundPictures, _: np.random.Generator) -> SurroundPictures:
    """As it is."""
    return pictures


def told_height(factor: float = 1.0, metres: float = 0.0) -> Change:
    """Tell the network other heights of the cameras above the ground."""

    def change(pictures: SurroundPictures, _: np.random.Generator) -> SurroundPictures:
        poses = pictures.base_T_camera.copy()
        poses[:, 2, 3] = poses[:, 2, 3] * factor + metres
        return replace(pictures, base_T_camera=poses)

    return change


def told_turned(pitch: float = 0.0, roll: float = 0.0) -> Change:
    """Tell the network that its cameras look down by `pitch` and lean to the right by `roll` degrees more."""

    def change(pictures: SurroundPictures, _: np.random.Generator) -> SurroundPictures:
        poses = pictures.base_T_camera.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ turned(pitch, roll)
        return replace(pictures, base_T_camera=poses)

    return change


def seen(change_one: Callable[[NDArray[np.float32], np.random.Generator], NDArray[np.float32]]) -> Change:
    """Change every picture, [H, W, 3] in [0, 1]."""

    def change(pictures: SurroundPictures, random: np.random.Generator) -> SurroundPictures:
        changed = [change_one(picture.astype(np.float32) / 255, random) for picture in pictures.pictures]
        return replace(pictures, pictures=(np.clip(np.stack(changed), 0, 1) * 255 + 0.5).astype(np.uint8))

    return change


def night(picture: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.float32]:
    """Leave a twelfth of the light, bluish, with the noise of a sensor that amplifies it again by three."""
    light = picture**2.2 / 12 * np.array([0.8, 0.9, 1.2], np.float32)
    noisy = light + random.normal(0, 0.004, picture.shape).astype(np.float32)
    return np.asarray(np.clip(3 * noisy, 0, 1) ** (1 / 2.2), dtype=np.float32)


def rain(picture: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.float32]:
    """Draw a grey veil, streaks, and thirty drops on the lens behind which all is blurred."""
    height, width = picture.shape[:2]
    streaks = (random.random((height, width)) > 0.997).astype(np.float32)
    veiled = 0.75 * picture + 0.15 + 0.8 * cv2.blur(streaks, (1, 9))[..., None]
    drops = np.zeros((height, width), np.float32)
    for u, v, radius in random.integers((0, 0, 2), (width, height, 7), (30, 3)).tolist():
        cv2.circle(drops, (u, v), radius, 1.0, -1)
    soft = cv2.GaussianBlur(drops, (0, 0), 1.0)[..., None]
    return np.asarray(veiled * (1 - soft) + cv2.GaussianBlur(veiled, (0, 0), 6.0) * soft, dtype=np.float32)


def blur(picture: NDArray[np.float32], _: np.random.Generator) -> NDArray[np.float32]:
    """Out of focus: 1.5 of the network's pixels."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.5))


AS_IT_IS = "as it is"
TOLD_WRONGLY: dict[str, Change] = {
    "cameras told 10 % higher": told_height(1.1),
    "cameras told 10 % lower": told_height(0.9),
    "ground told 0.4 m too low": told_height(metres=0.4),
    "ground told 0.4 m too high": told_height(metres=-0.4),
    "pitch told 1 degree down": told_turned(pitch=1),
    "pitch told 1 degree up": told_turned(pitch=-1),
    "pitch told 2 degrees down": told_turned(pitch=2),
    "pitch told 2 degrees up": told_turned(pitch=-2),
    "roll told 2 degrees": told_turned(roll=2),
}
CHANGES: dict[str, Change] = {
    **TOLD_WRONGLY,
    "night": seen(night),
    "rain": seen(rain),
    "blur": seen(blur),
}


def cases_of(estimator: DepthEstimator) -> list[str]:
    """Return the changes that can change anything."""
    return [case for case in CHANGES if estimator.spec.is_told_its_rig or case not in TOLD_WRONGLY]


# The same pictures as another rig shows them.


class Shown(NamedTuple):
    """A view of each camera's picture."""

    zoom: float = 1.0
    aside: float = 0.0
    """Of the picture's width by which the middle lies to the right."""
    pitch: float = 0.0
    """Degrees down."""
    roll: float = 0.0
    """Degrees to the right."""
    aspect: Aspect = "crop"


SHOWN_BY = {
    "lenses 1.5 times as long": Shown(zoom=1.5),
    "lenses twice as long": Shown(zoom=2.0),
    "tilted down by 8 degrees, 1.3 times as long": Shown(zoom=1.3, pitch=8),
    "tilted up by 8 degrees, 1.3 times as long": Shown(zoom=1.3, pitch=-8),
    "rolled by 5 degrees, 1.3 times as long": Shown(zoom=1.3, roll=5),
    "cut aside by a fifth, 1.4 times as long": Shown(zoom=1.4, aside=0.2),
    "stretched to the network's shape": Shown(aspect="stretch"),
    "upside down": Shown(roll=180),
}


def shown_by(layout: RigLayout, shown: Shown) -> RigLayout:
    """Return the rig whose cameras show this of their pictures; its calibrations and poses are those of the views."""
    return layout.model_copy(
        update={"cameras": tuple(view_of(entry, shown) for entry in layout.cameras), "aspect": shown.aspect}
    )


def view_of(entry: CameraEntry, shown: Shown) -> CameraEntry:
    """Return a camera of a complete layout with another view of the same pictures."""
    if entry.calibration is None or entry.base_T_camera is None:
        raise ValueError(f"camera {entry.name}: its layout is not complete")
    camera_R_view = turned(shown.pitch, shown.roll)
    width, height = entry.calibration.image_size
    K = entry.calibration.rectified_intrinsics
    fx, fy = shown.zoom * K[0, 0], shown.zoom * K[1, 1]
    cx, cy = (width - 1) / 2 - shown.aside * width, (height - 1) / 2
    pose = entry.base_T_camera.matrix(entry.name)
    pose[:3, :3] = pose[:3, :3] @ camera_R_view
    r = tuple((camera_R_view.T @ entry.calibration.rotation).ravel().tolist())
    p = (float(fx), 0.0, cx, 0.0, 0.0, float(fy), cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    calibration = entry.calibration.model_copy(update={"r": r, "p": p})
    return entry.model_copy(update={"calibration": calibration, "base_T_camera": PoseEntry.from_matrix(pose)})


def turned(pitch: float, roll: float) -> NDArray[np.float64]:
    """Return camera_R_view [3, 3] of a view that looks down by `pitch` and leans to the right by `roll` degrees."""
    a, b = math.radians(pitch), math.radians(roll)
    down = np.array([[1, 0, 0], [0, math.cos(a), math.sin(a)], [0, -math.sin(a), math.cos(a)]])
    right = np.array([[math.cos(b), -math.sin(b), 0], [math.sin(b), math.cos(b), 0], [0, 0, 1]])
    return np.asarray(down @ right)


# Tables.

TITLES = (
    "Abs Rel",
    "delta < 1.25",
    "scale true / predicted",
    "worst camera",
    "best constant",
    "cameras better",
    "sky IoU",
    "obstacles within 20 m: recall / precision",
)


def markdown(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the tables in Markdown: drives as they are, the street by other rigs, what is told or seen wrongly."""
    plain = [row for row in rows if row["part"] in (WORLDS, STREET)]
    yield table("drive", [(row["recording"], row) for row in plain])
    street = [row for row in plain if row["part"] == STREET]
    shown = [(row["case"], row) for row in rows if row["part"] == SHOWN]
    if shown:
        yield table("the street, shown by", [*((AS_IT_IS, row) for row in street), *shown])
    for kind in (WORLDS, STREET):
        base = [row for row in plain if row["part"] == kind]
        if base:
            yield table(f"told or seen wrongly, {kind}", told_rows(rows, base))


def told_rows(rows: Sequence[Row], base: Sequence[Row]) -> list[tuple[str, Row]]:
    """Return the mean over the recordings of each change."""
    names = {row["recording"] for row in base}
    of_changes = {
        case: [row for row in rows if row["part"] == TOLD and row["case"] == case and row["recording"] in names]
        for case in CHANGES
    }
    return [(case, mean_row(found)) for case, found in {AS_IT_IS: list(base), **of_changes}.items() if found]


def mean_row(rows: Sequence[Row]) -> Row:
    """Return the mean over recordings; the worst camera of all."""
    told = [row["sky_iou"] for row in rows if row["sky_iou"] is not None]
    return {
        **{key: mean(row[key] for row in rows) for key in ("abs_rel", "delta", "constant")},
        "scale": geometric_mean(row["scale"] for row in rows),
        "worst": max((row["worst"] for row in rows), key=lambda worst: worst[1]),
        "better": [sum(row["better"][i] for row in rows) for i in range(2)],
        "sky_iou": mean(told) if told else None,
        **{key: mean(row[key] for row in rows) for key in ("recall", "precision")},
    }


def table(title: str, rows: Sequence[tuple[str, Row]]) -> str:
    """Return one table."""
    lines = [f"| {title} | {' | '.join(TITLES)} |", f"|---|{'---|' * len(TITLES)}"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(cells(row))} |" for name, row in rows)])


def cells(row: Row) -> list[str]:
    """Return what stands below the titles."""
    if "refused" in row:
        return [f"refused: {row['refused'].partition(',')[0]}", *[""] * (len(TITLES) - 1)]
    camera, worst = row["worst"]
    better, cameras = row["better"]
    sky = "" if row["sky_iou"] is None else f"{row['sky_iou']:.2f}"
    numbers = [f"{row['abs_rel']:.3f}", f"{row['delta']:.2f}", f"{row['scale']:.2f}"]
    obstacles = f"{row['recall']:.2f} / {row['precision']:.2f}"
    return [*numbers, f"{camera} {worst:.3f}", f"{row['constant']:.3f}", f"{better} of {cameras}", sky, obstacles]


def sources(options: argparse.Namespace) -> Iterator[Source]:
    """Yield the recordings."""
    for path in options.worlds:
        yield Source(WORLDS, path, None, 0.0, 1)
    if options.street:
        layout = load_rig_layout(options.rig) if options.rig else None
        yield Source(STREET, options.street, layout, options.start, options.every)


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="file, or 'default'")
    parser.add_argument("--worlds", nargs="+", default=[], metavar="DRIVE", help="simulated drives with true depth")
    parser.add_argument("--street", metavar="DRIVE", help="a recording with a LiDAR")
    parser.add_argument("--rig", type=Path, help="the street's rig file [the cameras found]")
    parser.add_argument("--start", type=float, default=0.0, help="seconds of the street to skip [0]")
    parser.add_argument("--every", type=int, default=2, help="of the street's sets, one of so many [2]")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the results")
    return parser.parse_args()


if __name__ == "__main__":
    main()
