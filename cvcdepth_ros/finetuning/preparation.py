# SPDX-License-Identifier: Apache-2.0
"""The recordings of a run made ready before its first step: checked, indexed, the vehicle's own body masked.

All of it is kept in the run's folder, so that the same command again, and the other processes of a run, find it there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from cvcdepth_core.errors import CvcDepthError, RecordingError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.refinement.odometry_check import STEPS_TO_JUDGE
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.training.config import MotionSource
from cvcdepth_ros.bags import Location, file_identities, open_recording
from cvcdepth_ros.checks import CheckContext, CheckOptions, CheckResult, NumberedResult, run_checks
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.kept import Arrays, KeptResults, document_array, read_document
from cvcdepth_ros.recordings.compared_pictures import JudgedOdometry, judge_odometry, parts_of
from cvcdepth_ros.recordings.ground import RecordedGround, recorded_ground
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings, ModelSettings
from cvcdepth_ros.training_data.index import RecordingIndex, ScaleSource, load_index
from cvcdepth_ros.training_data.own_body_masks import find_self_occlusion, save_masks

NOT_NEEDED: Collection[str] = ("stamps", "LiDAR")
"""Checks whose failure does not spoil a training: the check of sets tells what odd stamps cost."""

COUNTED_HERE: Collection[str] = ("training", "pose network")
"""Checks of what a run finds out by itself, from the very recordings that are left."""

_CHECKS_FOLDER, _INDEX_FOLDER, _GROUND_FOLDER = "checks", "index", "ground"
_MASKS_FOLDER, _FOUND_FILE = "masks", "found.json"
_ODOMETRY_FOLDER, _WITHOUT_MOTION_FOLDER = "odometry", "without_motion"
_JUDGED_PARTS, _JUDGED_SECONDS = 2, 2.5  # of a recording, whose motion is compared with the pictures


@dataclass(frozen=True)
class Source:
    """The recordings to train on, and how to read them."""

    recordings: Sequence[Location]
    layout: RigLayout | None
    """The rig file's; None: the cameras found in each recording."""
    matching: MatchingSettings
    skipped_checks: Collection[str] = ()
    with_masks: bool = True
    """Whether to look for the vehicle's own body where the rig has no mask."""
    lidar: tuple[str, ...] | None = None
    """Topics of the LiDARs; none: the vehicle has none; None: those of each recording."""
    base_frame: str = "base_link"
    """The vehicle's frame, where `layout` is None."""
    motion: MotionSource = "network"
    """`recordings.motion` of the configuration."""
    needs_ground: bool = False
    """Whether the network is told how high the ground lies."""
    checkpoint: Path | None = None
    """Weights by whose depth recorded motion is compared with the pictures; None: it is taken as it is."""

    @property
    def scale_from(self) -> ScaleSource:
        """What the scale is learnt from."""
        return "overlaps" if self.motion == "network" else "overlaps or motion"


@dataclass
class Prepared:
    """The recordings of a run, ready to be trained on."""

    indexes: list[RecordingIndex] = field(default_factory=list)
    """The recordings that can be used, with masks in their rigs."""
    left_out: dict[str, str] = field(default_factory=dict)
    """By path: why the others cannot be used."""
    warnings: list[str] = field(default_factory=list)
    """One line about each loss or doubtful finding."""
    found_masks: dict[str, Path] = field(default_factory=dict)
    """Masks of the vehicle's own body that were found, by a name for each."""


def prepare(source: Source, run: Path) -> Prepared:
    """Return the recordings, checked, indexed and masked; RecordingError, with every reason, when none can be used."""
    prepared = Prepared()
    for path in source.recordings:
        try:
            checks = check_results(path, source, run)
            problems = [found for found in checks if found.result.status in ("failed", "warning")]
            _refuse(path, problems)
            index, doubts = _index_of(path, source, run)
            prepared.indexes.append(index)
            prepared.warnings += [*(_describe_finding(path, problem) for problem in problems), *doubts]
            prepared.warnings += [f"{path}: {loss}" for loss in index.losses]
        except (CvcDepthError, OSError) as error:
            prepared.left_out[str(path)] = str(error)
    if not prepared.indexes:
        raise RecordingError("; ".join(prepared.left_out.values()))
    if source.with_masks:
        _add_masks(prepared, run)
    return prepared


def _index_of(path: Location, source: Source, run: Path) -> tuple[RecordingIndex, list[str]]:
    """Return the recording's index with the ground's height, where it is needed, and what is doubtful about it."""
    index = load_index(path, run / _INDEX_FOLDER, source.matching, source.layout, source.base_frame, source.scale_from)
    if not source.needs_ground or index.layout.ground_height is not None:
        return _with_usable_motion(index, source, run)
    ground = _ground_of(index, source, run)
    if not ground.is_assumed:
        index = replace(index, layout=index.layout.model_copy(update={"ground_height": ground.height}))
    index, doubts = _with_usable_motion(index, source, run)
    return index, [f"{path}: {ground.told}", *doubts]


def _ground_of(index: RecordingIndex, source: Source, run: Path) -> RecordedGround:
    """Look for the ground in the recording; what was found before in the very same one and rig is kept."""

    def find() -> RecordedGround:
        with open_recording(index.path) as recording:
            return recorded_ground(RecordedRig.from_recording(recording, index.layout), source.lidar)

    work = {
        "version": package_version(),
        "files": file_identities(index.path),
        "lidar": source.lidar,
        "rig": index.layout.model_dump(mode="json"),
    }
    kept = KeptResults(run / _GROUND_FOLDER, _ground_to_arrays, _ground_from_arrays)
    return kept.load_or_make(str(index.path), work, find)


def _ground_to_arrays(ground: RecordedGround) -> Arrays:
    return {"ground": document_array(ground.to_json())}


def _ground_from_arrays(arrays: Arrays) -> RecordedGround:
    return RecordedGround.from_json(read_document(arrays["ground"]))


def check_results(path: Location, source: Source, run: Path) -> list[NumberedResult]:
    """Return the results of `cvcdepth check`, found now, or before in the very same recording and rig."""
    matching, layout = source.matching, source.layout
    options = CheckOptions(
        tolerance=matching.tolerance, queue_size=matching.queue_size, base_frame=source.base_frame, lidar=source.lidar
    )
    work = {
        "version": package_version(),
        "files": file_identities(path),
        "options": {name: value for name, value in asdict(options).items() if name not in ("training", "checkpoint")},
        "skipped": sorted(source.skipped_checks),
        "rig": None if layout is None else layout.model_dump(mode="json"),
    }

    def run_all() -> list[NumberedResult]:
        with open_recording(path) as recording:
            return run_checks(CheckContext(recording, options, layout), {*source.skipped_checks, *COUNTED_HERE})

    kept = KeptResults(run / _CHECKS_FOLDER, _checks_to_arrays, _checks_from_arrays)
    return kept.load_or_make(str(path), work, run_all)


def _with_usable_motion(index: RecordingIndex, source: Source, run: Path) -> tuple[RecordingIndex, list[str]]:
    """Return the index, without its motion where that contradicts the pictures, and what is doubtful about it.

    RecordingError where the configuration insists on such motion.
    """
    path = index.path
    if source.motion == "network":
        return index, []
    if index.poses is None:
        is_silent = source.motion == "recorded"  # the loader refuses
        return index, [] if is_silent else [f"{path}: no motion is recorded, so the pose network's is taken"]
    judged = _judged_odometry(index, source, run)
    if judged.is_usable:
        return index, [f"{path}: {judged.problem}"] if judged.problem else []
    if source.motion == "recorded":
        raise RecordingError(f"{path}: {judged.problem}; with recordings.motion: auto the pose network's is taken")
    folder, options = run / _INDEX_FOLDER / _WITHOUT_MOTION_FOLDER, (source.matching, source.layout, source.base_frame)
    without = load_index(path, folder, *options, "overlaps", with_motion=False)
    doubt = f"{path}: {judged.problem}, so it is not used, and the pose network's motion is taken"
    return replace(without, layout=index.layout, motion_problem=judged.problem), [doubt]


def _judged_odometry(index: RecordingIndex, source: Source, run: Path) -> JudgedOdometry:
    """Compare recorded motion with the pictures of two short parts, now or before in the very same recording."""
    if source.checkpoint is None or len(index) <= STEPS_TO_JUDGE:
        return JudgedOdometry("", is_usable=True)
    weights = load_checkpoint(source.checkpoint)
    work = {
        "version": package_version(),
        "files": file_identities(index.path),
        "matching": source.matching.model_dump(),
        "rig": index.layout.model_dump(mode="json"),
        "checkpoint": weights.sha256,
    }

    def judge_now() -> JudgedOdometry:
        with open_recording(index.path) as recording:
            recorded = RecordedRig.from_recording(recording, index.layout).completed()
            parts = parts_of(recording.start, recording.end + 1, _JUDGED_PARTS, _JUDGED_SECONDS)
            network = ModelSettings.model_validate({"checkpoint": str(source.checkpoint)}).build_estimator()
            try:
                return judge_odometry(recorded, network, parts, source.matching)
            except CvcDepthError as error:
                return JudgedOdometry(f"motion cannot be compared with the pictures: {error}", is_usable=True)

    kept = KeptResults(run / _ODOMETRY_FOLDER, _judged_to_arrays, _judged_from_arrays)
    return kept.load_or_make(str(index.path), work, judge_now)


def _judged_to_arrays(judged: JudgedOdometry) -> Arrays:
    return {"judged": document_array(judged._asdict())}


def _judged_from_arrays(arrays: Arrays) -> JudgedOdometry:
    return JudgedOdometry(**read_document(arrays["judged"]))


def _checks_to_arrays(checks: list[NumberedResult]) -> Arrays:
    return {"checks": document_array([(number, name, asdict(result)) for number, name, result in checks])}


def _checks_from_arrays(arrays: Arrays) -> list[NumberedResult]:
    found = read_document(arrays["checks"])
    return [NumberedResult(number, name, CheckResult(**result)) for number, name, result in found]


def _refuse(path: Location, problems: Sequence[NumberedResult]) -> None:
    fatal = [found for found in problems if found.result.status == "failed" and found.name not in NOT_NEEDED]
    if fatal:
        raise RecordingError("; ".join(_describe_finding(path, found) for found in fatal))


def _describe_finding(path: Location, found: NumberedResult) -> str:
    remedy = f" -> {found.result.remedy}" if found.result.remedy else ""
    return f"{path}: check {found.number}, {found.name}: {found.result.finding}{remedy}"


def _add_masks(prepared: Prepared, run: Path) -> None:
    """Find the vehicle's own body once for every rig, in its longest recording."""
    layouts: list[RigLayout] = []
    for index in prepared.indexes:
        if index.layout not in layouts:
            layouts.append(index.layout)
    for layout in layouts:
        indexes = [index for index in prepared.indexes if index.layout == layout]
        masked = _masked(max(indexes, key=len), run, prepared.warnings)
        prepared.indexes = [
            replace(index, layout=masked) if index.layout == layout else index for index in prepared.indexes
        ]
        new = {camera.name: camera.mask for camera in masked.cameras if camera not in layout.cameras}
        folder = f"{_rig_digest(layout)}/" if len(layouts) > 1 else ""
        prepared.found_masks |= {f"{folder}{name}": mask for name, mask in new.items() if mask is not None}


def _masked(index: RecordingIndex, run: Path, warnings: list[str]) -> RigLayout:
    """Return the layout with the masks that were found in the recording, now or before; add what is doubtful of them.

    Pictures, found again by the rig alone: whoever paints over one must not lose it to another version of the program.
    """
    layout = index.layout
    folder = run / _MASKS_FOLDER / _rig_digest(layout)
    try:
        names = json.loads((folder / _FOUND_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = find_self_occlusion(index)
        warnings += [f"{index.path}: {doubt}" for doubt in found.doubts(folder)]
        masked = save_masks(layout, found, folder)
        names = [camera.name for camera in masked.cameras if camera not in layout.cameras]
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / _FOUND_FILE, json.dumps(names).encode())
        return masked
    cameras = [
        camera.model_copy(update={"mask": folder / f"{camera.name}.png"}) if camera.name in names else camera
        for camera in layout.cameras
    ]
    return layout.model_copy(update={"cameras": tuple(cameras)})


def _rig_digest(layout: RigLayout) -> str:
    """Return a hash of the rig; a height that is not stated is taken for 0, so that it is as good as one of 0."""
    return _digest(layout.model_copy(update={"ground_height": layout.ground_z}).model_dump_json())


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]
