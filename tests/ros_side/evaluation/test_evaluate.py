# SPDX-License-Identifier: Apache-2.0
"""`cvcdepth evaluate`: the depth that is scored, scores by strangers' arithmetic, many recordings, the page."""

import csv
import hashlib
import json
import math
import os
import re
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
import torch
import yaml
from numpy.typing import NDArray
from recordings import CAMERAS, SAMPLE, SAMPLE_MCAP
from repository import ROOT
from rosbags.highlevel import AnyReader
from s3_server import LocalS3

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.scoring.references import FixedDepth
from cvcdepth_ros import reports
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.evaluation.image_scores import LabelFree, SetScore
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import RecordingScores, Remeasuring, open_evaluation
from cvcdepth_ros.evaluation.result import Failure
from cvcdepth_ros.evaluation.trained_on import TrainedPart, to_metadata
from cvcdepth_ros.evaluation.workers import evaluate_all
from cvcdepth_ros.recordings.replay import DepthReplay
from cvcdepth_ros.reports.shown_sets import chosen_sets

SMALL = ("--untrained", "--height", "64", "--width", "96")
CONSTANT = ("--predictor", "constant", "--height", "96", "--width", "160")
FUSIONS = ((), ("--flip-fusion",), ("--flip-fusion", "--flip-fusion-of", "inverse_depth"))
Rows = dict[tuple[str, int, str], dict[str, str]]


def score(output: Path, *arguments: str | Path, report: bool = False) -> dict[str, Any]:
    """Evaluate; return metrics.json."""
    options = ["-o", str(output), "--quiet", *([] if report else ["--no-report"])]
    assert main(["evaluate", *map(str, arguments), *options]) == 0
    return metrics_of(output)


def metrics_of(output: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((output / "metrics.json").read_text())
    return content


def frames_of(output: Path) -> Rows:
    with (output / "per_frame.csv").open(newline="") as stream:
        return {(r["recording"], int(r["stamp_ns"]), r["camera"]): r for r in csv.DictReader(stream)}


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a constant predictor on the sample."""
    folder = tmp_path_factory.mktemp("sample") / "scores"
    score(folder, SAMPLE, *CONSTANT, "--no-occlusion-filter", report=True)
    return folder


@pytest.fixture(scope="module")
def two_sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's first two sets, with LiDAR, transforms and motion."""
    return recordings.write_rosbag2(tmp_path_factory.mktemp("short") / "two_sets", recordings.sample_entries(2))


# The same depth everywhere


@pytest.mark.parametrize("fused", [False, True])
def test_run_and_evaluate_give_the_same_depth_bit_for_bit(two_sets: Path, fused: bool, tmp_path: Path):
    settings = EvaluationSettings(untrained=True, height=64, width=96, flip_fusion=fused)
    job = EvaluationJob("two_sets", str(two_sets), settings)
    with open_evaluation(job) as evaluation:
        scored = [measured.estimated.result.depth for measured in evaluation.sets(*evaluation.window)]
    assert len(scored) == 2
    fusion = ["--flip-fusion"] if fused else []
    assert main(["run", str(two_sets), "-o", str(tmp_path / "depth"), *SMALL, *fusion]) == 0
    for index, name in enumerate(CAMERAS):
        stored = depth_images(tmp_path / "depth", f"/surround_depth/{name}/depth/image_rect")
        np.testing.assert_array_equal([depth[index] for depth in scored], stored)


def test_run_and_evaluate_refine_the_same_sets_alike_bit_for_bit(tmp_path: Path):
    recording = recordings.write_rosbag2(tmp_path / "four_sets", recordings.sample_entries(4))
    settings = EvaluationSettings(untrained=True, height=64, width=96, refine="geometry")
    with open_evaluation(EvaluationJob("four_sets", str(recording), settings)) as evaluation:
        scored = [measured.estimated.result for measured in evaluation.sets(*evaluation.window)]
    assert main(["run", str(recording), "-o", str(tmp_path / "depth"), *SMALL, "--refine", "geometry"]) == 0
    told = json.loads((tmp_path / "depth" / "run.json").read_text())["refinement"]
    assert told == {"motion": {"odometry": 4, "alignment": 0, "unknown": 0}, "odometry_problem": None}
    for index, name in enumerate(CAMERAS):
        for part, found in (("image_rect", [r.depth for r in scored]), ("confidence", [r.confidence for r in scored])):
            stored = depth_images(tmp_path / "depth", f"/surround_depth/{name}/depth/{part}")
            np.testing.assert_array_equal([values[index] for values in found], stored)
    assert any(result.confidence.any() for result in scored)


def test_confidence_is_scored_without_refinement_too_and_leaves_depth_as_it_is(two_sets: Path, tmp_path: Path):
    plain = score(tmp_path / "plain", two_sets, *SMALL)
    result = score(tmp_path / "sure", two_sets, *SMALL, "--confidence")
    assert plain["confidence"] is None
    assert result["scores"] == plain["scores"]
    assert result["confidence"]["mean"]["abs_rel"] > result["confidence"]["mean"]["surest_half"] > 0
    pixels = result["confidence"]["calibration"]["pixels"]
    assert sum(pixels) > 1000
    assert sum(count > 0 for count in pixels) > 2
    again = score(tmp_path / "sure", two_sets, *SMALL, "--confidence")
    assert again["confidence"] == result["confidence"]


def test_flip_fusion_is_of_depth_or_of_inverse_depth_and_told(two_sets: Path, tmp_path: Path):
    plain, depth, inverse = (
        score(tmp_path / str(number), two_sets, *SMALL, *options)
        for number, options in enumerate(
            ((), ("--flip-fusion",), ("--flip-fusion", "--flip-fusion-of", "inverse_depth"))
        )
    )
    errors = [result["scores"]["image"]["metric"]["mean"]["all"]["abs_rel"] for result in (plain, depth, inverse)]
    assert len(set(errors)) == 3
    assert errors[1] < errors[2]  # all depths are too small, and the mean of two is above their harmonic mean
    assert [result["model"]["id"].partition(", flip fusion of ")[2] for result in (depth, inverse)] == [
        "depth",
        "inverse depth",
    ]


def test_the_pose_network_is_compared_with_recorded_motion_where_there_is_any(tmp_path: Path):
    entries = recordings.sample_entries(4)
    moving = recordings.write_rosbag2(tmp_path / "moving", entries)
    blind = recordings.write_rosbag2(tmp_path / "blind", [e for e in entries if e.topic not in ("/tf", "/odom")])
    known, unknown = (score(tmp_path / f"of_{one.name}", one)["pose_network"] for one in (moving, blind))
    assert known["steps"] == 3
    assert 0.9 < known["recorded_metres"] < 1.6
    assert 0.5 < known["ratio"] < 1.3  # it has seen the sample
    assert known["degrees"] < 0.3
    assert unknown == {"steps": 0, "predicted_metres": None, "recorded_metres": None, "degrees": None, "ratio": None}


def test_a_reference_is_never_refined(two_sets: Path, tmp_path: Path):
    result = score(tmp_path / "constant", two_sets, *CONSTANT, "--refine", "geometry")
    assert result["recordings"][0]["refinement"] is None


def depth_images(path: Path, topic: str) -> list[NDArray[np.float32]]:
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        found = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections)]
    return [image.data.view(np.float32).reshape(image.height, image.width) for image in found]


def stamp_of(message: Any) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


# Whose clouds are truth


@pytest.fixture(scope="module")
def recorded_with_depth(two_sets: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first two sets as `ros2 bag record -a` has them while the node runs: with its clouds of random depth."""
    folder = tmp_path_factory.mktemp("recorded_with_depth")
    assert main(["run", str(two_sets), "-o", str(folder / "depth"), *SMALL, "--clouds", "all"]) == 0
    clouds = [entry for entry in recordings.entries_of(folder / "depth") if entry.topic.endswith("/points")]
    assert len({entry.topic for entry in clouds}) == 7
    entries = sorted([*recordings.entries_of(two_sets), *clouds], key=lambda entry: entry.log_time)
    return recordings.write_rosbag2(folder / "two_sets", entries)


def test_clouds_that_the_node_made_are_no_truth_unless_they_are_named(
    recorded_with_depth: Path, two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    score(tmp_path / "lidar", two_sets, *CONSTANT)
    capsys.readouterr()
    result = score(tmp_path / "all", recorded_with_depth, *CONSTANT)
    assert frames_of(tmp_path / "all") == frames_of(tmp_path / "lidar")
    own = ["/surround_depth/points", *(f"/surround_depth/{name}/points" for name in CAMERAS)]
    assert result["recordings"][0]["lidar"] == ["/lidar/points"]
    assert result["recordings"][0]["clouds_of_cameras"] == sorted(own)
    assert f"not taken for a LiDAR's, since their points have colours: {sorted(own)[0]}" in capsys.readouterr().err
    named = score(tmp_path / "named", recorded_with_depth, *CONSTANT, "--lidar", "/surround_depth/points")
    assert named["recordings"][0]["lidar"] == ["/surround_depth/points"]
    assert named["truth_points"] > 0


def test_a_cloud_in_a_frame_without_a_transform_is_told_and_costs_no_other(
    two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def lift(message: Any) -> None:
        message.header.frame_id = "roof"

    entries = recordings.entries_of(two_sets)
    sweeps = [entry._replace(topic="/roof/points") for entry in entries if entry.topic == "/lidar/points"]
    both = sorted([*entries, *recordings.changed(sweeps, "/roof/points", lift)], key=lambda entry: entry.log_time)
    score(tmp_path / "one", two_sets, *CONSTANT)
    (tmp_path / "bag").mkdir()
    score(tmp_path / "both", recordings.write_rosbag2(tmp_path / "bag" / "two_sets", both), *CONSTANT)
    assert frames_of(tmp_path / "both") == frames_of(tmp_path / "one")
    assert "/roof/points: no transform base_link <- roof: frame 'roof' is unknown" in capsys.readouterr().err


# The numbers


def test_abs_rel_is_what_a_strangers_loops_find(output: Path):
    """One image: sweep to world to camera by hand, the nearest point of each pixel, the mean of |10 - z| / z."""
    errors = strangers_errors("left", 3)
    key = next(key for i, key in enumerate(k for k in frames_of(output) if k[2] == "left") if i == 3)
    row = frames_of(output)[key]
    assert int(row["truth_points"]) == len(errors) > 1000
    assert float(row["abs_rel"]) == pytest.approx(np.mean(errors), rel=1e-9)
    assert float(row["coverage"]) == 1.0


def strangers_errors(camera: str, index: int) -> list[float]:
    messages: dict[str, list[Any]] = {}
    with AnyReader([SAMPLE]) as reader:
        for connection, _, raw in reader.messages():
            messages.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    static = {t.child_frame_id: matrix(t.transform) for m in messages["/tf_static"] for t in m.transforms}
    odom = {
        (t.header.stamp.sec, t.header.stamp.nanosec): matrix(t.transform) for m in messages["/tf"] for t in m.transforms
    }
    image = messages[f"/camera/{camera}/image_raw/compressed"][index]
    info = messages[f"/camera/{camera}/camera_info"][index]
    sweep = min(messages["/lidar/points"], key=lambda s: abs(seconds(s) - seconds(image)))
    count = sweep.width * sweep.height
    xyz = sweep.data.reshape(count, sweep.point_step)[:, :12].copy().view(np.float32).astype(float)
    chain = (
        np.linalg.inv(odom[stamp_of(image)] @ static[f"{camera}_camera_optical_frame"])
        @ odom[stamp_of(sweep)]
        @ static["pandar64"]
    )
    nearest: dict[tuple[int, int], float] = {}
    for x, y, z in xyz @ chain[:3, :3].T + chain[:3, 3]:
        if z > 0:
            pixel = math.floor(info.k[0] * x / z + info.k[2] + 0.5), math.floor(info.k[4] * y / z + info.k[5] + 0.5)
            if 0 <= pixel[0] < info.width and 0 <= pixel[1] < info.height:
                nearest[pixel] = min(z, nearest.get(pixel, math.inf))
    return [abs(10 - z) / z for z in nearest.values() if z < 80]


def seconds(message: Any) -> float:
    return float(message.header.stamp.sec - 1557539900 + message.header.stamp.nanosec * 1e-9)


def matrix(transform: Any) -> NDArray[np.float64]:
    q, t = transform.rotation, transform.translation
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t.z],
            [0, 0, 0, 1],
        ]
    )


def test_the_lidars_own_depth_as_prediction_has_no_error():
    settings = EvaluationSettings(predictor="constant", height=64, width=96)
    with open_evaluation(EvaluationJob("sample", str(SAMPLE), settings, duration=0.25)) as evaluation:
        first = next(iter(evaluation.sets(*evaluation.window)))
        depth = np.stack([truth.image() for truth in first.truth])
        K = np.array([camera.calibration.rectified_intrinsics for camera in evaluation.replay.rig.cameras])
    with open_evaluation(EvaluationJob("sample", str(SAMPLE), settings, duration=0.25)) as evaluation:
        evaluation.depths = DepthReplay(evaluation.replay, FixedDepth(depth, K[:, 0, 0], "the LiDAR"))
        again = next(iter(evaluation.sets(*evaluation.window)))
    for samples in again.samples():
        assert len(samples.truth) > 1000
        np.testing.assert_allclose(samples.prediction, samples.truth, rtol=1e-6)


def test_a_set_that_is_measured_again_is_the_same_whatever_was_measured_before_it():
    job = EvaluationJob("sample", str(SAMPLE), EvaluationSettings(untrained=True, height=64, width=96), duration=0.35)
    with open_evaluation(job) as evaluation:
        expected = list(evaluation.sets(*evaluation.window))
    with Remeasuring() as again:
        for measured in (expected[-1], expected[0], expected[0]):
            found = again.measured_set(job, measured.stamp_ns, measured.log_time)
            np.testing.assert_array_equal(found.estimated.result.depth, measured.estimated.result.depth)
            np.testing.assert_array_equal(found.lidar, measured.lidar)
        with pytest.raises(RecordingError, match=r"excerpt: no set at 7 ns"):
            again.measured_set(job, 7, measured.log_time)


def test_a_part_of_a_recording_scores_as_it_does_within_the_whole(output: Path, tmp_path: Path):
    """The LiDAR and the motion just outside of the part count too."""
    score(tmp_path, SAMPLE, *CONSTANT, "--no-occlusion-filter", "--start", "0.3", "--duration", "0.4")
    whole, part = frames_of(output), frames_of(tmp_path)
    assert len(part) in (18, 24)
    for key, row in part.items():
        assert [row[name] for name in ("truth_points", "abs_rel", "rmse")] == [
            whole[key][name] for name in ("truth_points", "abs_rel", "rmse")
        ]


def test_a_camera_whose_clock_is_ahead_is_scored_against_the_sweep_of_its_moment(two_sets: Path, tmp_path: Path):
    topic = "/camera/left/image_raw/compressed"
    shifted = recordings.restamped(recordings.sample_entries(2), topic, lambda _, stamp: stamp + 3_200_000_000)
    (tmp_path / "ahead").mkdir()
    ahead = recordings.write_rosbag2(tmp_path / "ahead" / "two_sets", shifted)
    assert main(["rig", str(two_sets), "-o", str(tmp_path / "rig.yaml")]) == 0
    rig = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    next(camera for camera in rig["cameras"] if camera["name"] == "left")["stamp_offset"] = 3.2
    (tmp_path / "ahead.yaml").write_text(yaml.safe_dump(rig))
    score(tmp_path / "as_it_was", two_sets, *CONSTANT, "--rig", tmp_path / "rig.yaml")
    score(tmp_path / "out", ahead, *CONSTANT, "--rig", tmp_path / "ahead.yaml")
    assert frames_of(tmp_path / "out") == frames_of(tmp_path / "as_it_was")


def test_the_occlusion_filter_takes_points_away(output: Path, tmp_path: Path):
    filtered = score(tmp_path, SAMPLE, *CONSTANT)
    everything = metrics_of(output)
    assert 0.5 * everything["truth_points"] < filtered["truth_points"] < 0.99 * everything["truth_points"]


def test_depth_limits_leave_truth_out(output: Path, tmp_path: Path):
    limited = score(tmp_path, SAMPLE, *CONSTANT, "--no-occlusion-filter", "--min-depth", "10", "--max-depth", "20")
    bins = [metrics_of(output)["scores"]["image"]["metric"]["mean"]["10-20"]["truth_points"]]
    assert [limited["truth_points"]] == pytest.approx(bins, rel=1e-3)


def test_without_lidar_the_label_free_scores_remain(two_sets: Path, tmp_path: Path):
    result = score(
        tmp_path, two_sets, "--predictor", "ground_plane", "--height", "64", "--width", "96", "--no-lidar", report=True
    )
    assert result["truth_points"] == 0
    assert result["scores"]["image"]["metric"]["mean"]["all"]["abs_rel"] is None
    kinds = {pair["kind"] for pair in result["label_free"]["pairs"] if pair["sets"]}
    assert kinds == {"spatial", "temporal"}
    page = (tmp_path / "report.html").read_text()
    assert "No truth" in page
    assert "Worst set" in page


def test_flat_ground_agrees_with_itself_far_better_than_a_wall_around_every_camera(output: Path, tmp_path: Path):
    flat = score(
        tmp_path, SAMPLE, "--predictor", "ground_plane", "--height", "64", "--width", "96", "--duration", "0.3"
    )
    medians = [
        np.median([p["median"] for p in result["label_free"]["pairs"] if p["kind"] == "spatial" and p["sets"]])
        for result in (flat, metrics_of(output))
    ]
    assert medians[0] < 0.03 < medians[1]


def test_without_lidar_the_label_free_scores_of_cameras_and_references_are_printed(
    two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    result = score(tmp_path, two_sets, *SMALL, "--no-lidar", "--ground-height", "-0.4")
    printed = table_of(capsys.readouterr().out)
    assert list(printed) == [*result["recordings"][0]["cameras"], "all", "constant 10 m", "ground at -0.4 m"]
    found = result["label_free"]
    for camera, numbers in (*found["cameras"].items(), ("all", found["mean"])):
        known = [numbers[name] for name in LabelFree._fields]
        assert printed[camera] == ["-" if number is None else f"{number:.3f}" for number in known]
    for pair in found["pairs"]:
        if pair["kind"] == "temporal":  # one for each camera
            assert found["cameras"][pair["camera"]]["temporal"] == pytest.approx(pair["median"])
    assert found["mean"]["temporal"] == pytest.approx(np.mean([c["temporal"] for c in found["cameras"].values()]))


def table_of(text: str) -> dict[str, list[str]]:
    """Return the first table's cells by the first one, which may be of several words."""
    lines = text.splitlines()
    assert all(len(line) <= 80 for line in lines[: lines.index("")]), text
    rows = [re.split(r"\s{2,}", line.strip()) for line in lines[1 : lines.index("")]]
    return {name: cells for name, *cells in rows if cells}


@pytest.mark.parametrize("name", ["constant", "ground_plane"])
def test_a_reference_beside_the_model_scores_as_it_does_alone(
    name: str, two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    options = ("--ground-height", "-0.4", "--constant-depth", "8")
    beside = score(tmp_path / "beside", two_sets, *SMALL, *options)
    printed = table_of(capsys.readouterr().out)["constant 8 m" if name == "constant" else "ground at -0.4 m"]
    alone = score(tmp_path / "alone", two_sets, "--predictor", name, "--height", "64", "--width", "96", *options)
    for scaling in ("metric", "median"):
        expected = alone["scores"]["image"][scaling]["mean"]["all"]
        assert beside["references"][name]["scores"][scaling] == pytest.approx(expected, rel=1e-9)
    assert printed[0] == f"{alone['scores']['image']['metric']['mean']['all']['abs_rel']:.3f}"


def test_no_constant_is_better_than_the_best_constant_of_each_image(output: Path, two_sets: Path, tmp_path: Path):
    best = metrics_of(output)["references"]["best_constant"]["scores"]["metric"]["abs_rel"]
    assert best < metrics_of(output)["scores"]["image"]["metric"]["mean"]["all"]["abs_rel"]
    assert best <= metrics_of(output)["scores"]["image"]["median"]["mean"]["all"]["abs_rel"]


def test_ground_that_is_not_below_the_cameras_is_left_out_with_the_reason(
    two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    result = score(tmp_path, two_sets, *SMALL, "--ground-height", "5")
    assert list(result["references"]) == ["constant", "best_constant"]
    assert "no flat ground to compare with: ground plane: the ground at z = 5.0 m is not" in capsys.readouterr().out


# A model that knows what it is scored on


def test_the_packages_own_model_says_that_it_was_trained_on_the_sample(
    two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    result = score(tmp_path, two_sets, report=True)
    expected = {"recording": "two_sets", "trained_as": "pandaset_002", "sets": 2, "scored": 2}
    assert result["trained_on"] == [expected]
    assert "two_sets: the model was trained on 2 of these 2 sets (pandaset_002)" in capsys.readouterr().out
    assert "trained on 2 of the 2 sets of two_sets" in (tmp_path / "report.html").read_text()


def test_a_checkpoint_that_was_trained_elsewhere_or_does_not_say_is_not_accused(
    two_sets: Path, checkpoints: list[Path], tmp_path: Path
):
    assert score(tmp_path / "silent", two_sets, "--checkpoint", checkpoints[0])["trained_on"] == []
    elsewhere = TrainedPart.from_stamps("other", np.arange(1557539960 * 10**9, 1557539962 * 10**9, 10**8 + 7))
    assert score(tmp_path / "other", two_sets, "--checkpoint", told(tmp_path, elsewhere))["trained_on"] == []


def test_sets_after_the_trained_part_are_not_counted(tmp_path: Path):
    stamps = np.array([m["stamp_ns"] for m in stamps_of_sample()], dtype=np.int64)
    trained = TrainedPart.from_stamps("monday", stamps[:4])
    result = score(tmp_path / "scores", SAMPLE, "--checkpoint", told(tmp_path, trained))
    assert [(seen["sets"], seen["scored"], seen["trained_as"]) for seen in result["trained_on"]] == [(4, 10, "monday")]


def stamps_of_sample() -> list[dict[str, int]]:
    job = EvaluationJob("sample", str(SAMPLE), EvaluationSettings(predictor="constant", height=64, width=96), lidar=())
    with open_evaluation(job) as evaluation:
        return [{"stamp_ns": measured.stamp_ns} for measured in evaluation.sets(*evaluation.window)]


def told(folder: Path, part: TrainedPart) -> Path:
    """Return a checkpoint that says that it was trained on the part."""
    spec = DepthModelSpec(encoder="efficientnet_lite0", height=64, width=96, min_depth=1.0, max_depth=50.0)
    torch.manual_seed(1)
    path = folder / "told.safetensors"
    save_checkpoint(path, spec, DepthNet(spec.encoder).state_dict(), metadata=to_metadata([part]))
    return path


def test_a_set_without_truth_is_not_shown_as_the_best_beside_sets_that_have_it():
    sets = [SetScore("drive", number, 0, error, LabelFree(0.05)) for number, error in enumerate((0.3, math.nan, 0.2))]
    assert [(title, found.number) for title, found in chosen_sets(sets)] == [("Median set", 2), ("Worst set", 0)]
    assert [found.number for _, found in chosen_sets(sets[1:2])] == [1]


# What is written


DOCUMENTATION = (ROOT / "docs" / "evaluation.md").read_text(encoding="utf-8")
NAMES_VARY = re.compile(
    r"scores(\.\*)?|scale_ratio(\.\*)?|scores\.\*\.\*\.(mean|cameras)(\.\*)*|label_free\.rank_correlation_with_abs_rel"
    r"|label_free\.(mean|cameras(\.\*)?)|references(\.\*\.(scores(\.\*)?|label_free))?|obstacles\.within"
)


def documented(heading: str) -> set[str]:
    """The names in the first column of the table below a heading."""
    section = DOCUMENTATION.split(f"# {heading}\n")[1].split("\n#")[0]
    return set(re.findall(r"^\| `([^`]+)` \|", section, re.MULTILINE))


def fields(value: Any, path: str = "") -> Iterator[str]:
    """Name the leaves as the documentation does: `*` for a name that varies, `[]` for the items of a list."""
    if isinstance(value, dict) and path not in ("configuration", "rows"):
        for name, child in value.items():
            yield from fields(child, f"{path}.{'*' if NAMES_VARY.fullmatch(path) else name}".removeprefix("."))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        yield from fields(value[0], f"{path}[]")
    else:
        yield path


def test_metrics_json_has_exactly_the_fields_that_the_documentation_names(in_turn: Path):
    result = metrics_of(in_turn)
    assert documented("metrics.json") == set(fields(result))
    image = result["scores"]["image"]
    assert (
        documented("Scores")
        == image["metric"]["mean"]["all"].keys()
        == image["median"]["cameras"]["left"]["all"].keys()
    )
    assert documented("Groups of pixels") == image["metric"]["mean"].keys()
    assert documented("Label-free scores") == result["label_free"]["rank_correlation_with_abs_rel"].keys()
    assert result["scores"].keys() == {"image", "pool"}


def test_per_frame_csv_has_exactly_the_columns_that_the_documentation_names(output: Path):
    columns = next(iter(frames_of(output).values())).keys()
    scores = documented("Scores") - {"coverage", "truth_points", "measurements"}
    named = documented("per_frame.csv") | scores | {f"{name}_median_scaled" for name in scores}
    assert columns == named | documented("Label-free scores")


def test_every_image_has_a_line(output: Path):
    rows = frames_of(output)
    assert len(rows) == 60
    assert [key[2] for key in rows][:6] == list(CAMERAS)
    result = metrics_of(output)
    assert sum(int(row["truth_points"]) for row in rows.values()) == result["truth_points"]
    left = [float(row["abs_rel"]) for key, row in rows.items() if key[2] == "left"]
    assert np.mean(left) == pytest.approx(result["scores"]["image"]["metric"]["cameras"]["left"]["all"]["abs_rel"])


class Page(HTMLParser):
    """What a page loads, runs and shows."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.alts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        self.alts += [value or "" for name, value in attrs if name == "alt"]


def test_the_page_needs_nothing_beside_it_and_shows_every_picture(output: Path):
    page = Page((output / "report.html").read_text())
    assert all(source.startswith("data:image/") for source in page.sources)
    assert not {"script", "link", "iframe"} & set(page.tags)
    for name in CAMERAS:
        assert [alt for alt in page.alts if alt.endswith(f"camera {name}")] == [
            *(f"{which} set, error, camera {name}" for which in ("Best", "Median", "Worst")),
            f"LiDAR, camera {name}",
        ]
    assert {"Abs Rel by range", "Abs Rel by camera", "Abs Rel over disagreement"} <= set(page.alts)


def test_names_from_files_are_text_on_the_page_and_nothing_else(two_sets: Path, tmp_path: Path):
    hostile = "a$b_<script>alert(1)</script>\"'&{{ 7 * 7 }}"
    folder = tmp_path / hostile.replace("/", "_")
    shutil.copytree(two_sets, folder)
    result = score(tmp_path / "out", folder, *CONSTANT, report=True)
    assert result["recordings"][0]["name"] == folder.name
    text = (tmp_path / "out" / "report.html").read_text()
    assert "script" not in Page(text).tags
    assert "&lt;script&gt;" in text
    assert "{{ 7 * 7 }}" in text


def test_without_the_packages_for_the_page_everything_else_is_written(
    two_sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(reports, "find_spec", lambda name: None if name == "matplotlib" else object())
    assert score(tmp_path, two_sets, *CONSTANT, report=True)["sets"] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "matplotlib" in line
    assert "cvcdepth_ros[report]" in line
    assert {path.name for path in tmp_path.iterdir()} == {"metrics.json", "per_frame.csv", "parts"}


# Many recordings


@pytest.fixture(scope="module")
def drives(two_sets: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an intact recording, one cut by a power loss, and a file that is none."""
    folder = tmp_path_factory.mktemp("drives")
    shutil.copytree(two_sets, folder / "two_sets")
    recordings.cut(SAMPLE_MCAP, folder / "cut.mcap", 0.6)
    (folder / "none.mcap").write_bytes(b"this was never a recording")
    return folder


@pytest.fixture(scope="module")
def in_turn(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in_turn")
    score(folder, drives, *SMALL, report=True)
    return folder


def test_two_workers_give_exactly_the_files_of_one(drives: Path, in_turn: Path, tmp_path: Path):
    score(tmp_path, drives, *SMALL, "--workers", "2", report=True)
    for name in ("metrics.json", "per_frame.csv", "report.html"):
        assert (tmp_path / name).read_bytes() == (in_turn / name).read_bytes()


def test_every_recording_has_a_line_and_every_rig_a_number(
    two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    entries = [entry for entry in recordings.entries_of(two_sets) if "/camera/left/" not in entry.topic]
    drives = tmp_path / "drives"
    shutil.copytree(two_sets, drives / "monday")
    shutil.copytree(two_sets, drives / "tuesday")
    recordings.write_rosbag2(drives / ("a_van_without_its_left_camera" * 3), entries)
    score(tmp_path / "scores", drives, *CONSTANT)
    lines = capsys.readouterr().out.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("recording "))
    names = [re.split(r"\s{2,}", line)[0] for line in lines[first + 1 : first + 4]]
    assert names == ["1: a_van_w…ft_camera", "2: monday", "2: tuesday"]
    assert lines[first + 5] == "rig 2: front, front_left, left, back, right, front_right"
    assert all(len(line) <= 80 for line in lines if re.search(r"\d\.\d{3} ", line))


def test_a_recording_that_fails_is_named_and_stops_no_other(drives: Path, in_turn: Path):
    result = metrics_of(in_turn)
    assert [recording["name"] for recording in result["recordings"]] == ["cut.mcap", "two_sets"]
    (failed,) = result["failed"]
    assert failed["name"] == "none.mcap"
    assert "begins with b'this was never" in failed["reason"]
    assert "none.mcap" in (in_turn / "report.html").read_text()


def test_a_cut_recording_is_scored_up_to_the_cut_and_says_how_much_that_is(
    drives: Path, output: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    result = score(tmp_path, drives / "cut.mcap", *CONSTANT, "--no-occlusion-filter")
    warning = capsys.readouterr().err
    assert "not everything could be read" in warning
    assert f"evaluated {result['sets']} sets" in warning
    assert 3 <= result["sets"] < 10
    whole = {key[1:]: row["abs_rel"] for key, row in frames_of(output).items()}
    before_the_cut = {key[1:]: row["abs_rel"] for key, row in frames_of(tmp_path).items()}
    last = max(stamp for stamp, _ in before_the_cut)
    assert all(whole[key] == value for key, value in before_the_cut.items() if key[0] < last)


def test_the_program_fails_only_when_nothing_could_be_evaluated(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = ["evaluate", str(drives / "none.mcap"), "-o", str(tmp_path / "out"), *CONSTANT]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "nothing could be evaluated" in line
    assert "none.mcap" in line
    assert not (tmp_path / "out").exists()


class DeadlyJob(EvaluationJob):
    """Whoever receives it dies at once, as a process does that the kernel kills for want of memory."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (9,)


def test_a_worker_that_dies_costs_its_own_recording_only(two_sets: Path):
    settings = EvaluationSettings(predictor="constant", height=64, width=96)
    jobs = [cls(cls.__name__, str(two_sets), settings) for cls in (DeadlyJob, EvaluationJob)]
    found = {job.name: outcome for job, outcome in evaluate_all(jobs, workers=2)}
    failure, scores = found["DeadlyJob"], found["EvaluationJob"]
    assert isinstance(failure, Failure)
    assert "died" in failure.reason
    assert isinstance(scores, RecordingScores)
    assert scores.summary["sets"]["scored"] == 2


def test_a_lidar_topic_that_is_not_there_is_named(two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arguments = ["evaluate", str(two_sets), "-o", str(tmp_path / "out"), *CONSTANT, "--lidar", "/roof"]
    assert main(arguments) == 1
    assert "LiDAR /roof: no such topic" in (line := capsys.readouterr().err)
    assert "/lidar/points" in line


def test_finished_recordings_are_not_done_again(two_sets: Path, tmp_path: Path):
    """A mark in what was kept shows up in the result when, and only when, it was used."""
    recording, out = tmp_path / "drive", tmp_path / "out"
    shutil.copytree(two_sets, recording)
    first = score(out, recording, *CONSTANT)
    (part,) = (out / "parts").iterdir()

    def mark() -> None:
        arrays = dict(np.load(part))
        described = json.loads(arrays["described"].tobytes())
        described["summary"]["damage"] = "kept"
        arrays["described"] = np.frombuffer(json.dumps(described).encode(), dtype=np.uint8)
        np.savez(part, **arrays)

    def was_kept(*options: str) -> bool:
        mark()
        return bool(score(out, recording, *CONSTANT, *options)["recordings"][0]["damage"] == "kept")

    assert was_kept()
    assert not was_kept("--max-depth", "60")
    score(out, recording, *CONSTANT)
    (recording / "metadata.yaml").touch()
    assert not was_kept()
    part.write_bytes(part.read_bytes()[:1000])
    assert score(out, recording, *CONSTANT) == first


def test_a_recording_in_a_bucket_scores_as_the_file_does_and_is_not_read_whole(
    output: Path, s3: LocalS3, tmp_path: Path
):
    drive = recordings.write_mcap(tmp_path / "drive.mcap", long_drive())
    url = s3.put(drive, "drive.mcap")
    window = (*CONSTANT, "--no-occlusion-filter", "--start", "0.3", "--duration", "0.2")
    score(tmp_path / "out", url, *window)
    sent = s3.sent
    assert 0 < sent < drive.stat().st_size
    whole = {key[1:]: row["abs_rel"] for key, row in frames_of(output).items()}
    part = {key[1:]: row["abs_rel"] for key, row in frames_of(tmp_path / "out").items()}
    assert len(part) in (6, 12)
    assert part.items() <= whole.items()
    score(tmp_path / "out", url, *window)
    assert s3.sent == sent


def long_drive() -> Iterator[recordings.Entry]:
    """The sample, and its images twice more, a second later each."""
    entries = recordings.sample_entries()
    yield from entries
    for seconds_later in (1, 2):
        for entry in entries:
            if "Image" in entry.type:
                yield entry._replace(log_time=entry.log_time + seconds_later * 10**9)


# Comparison


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("checkpoints")
    spec = DepthModelSpec(encoder="resnet18", height=64, width=96, min_depth=1.5, max_depth=200.0)
    paths = []
    for seed, name in enumerate(("old", "new")):
        torch.manual_seed(seed)
        paths.append(folder / f"{name}.safetensors")
        save_checkpoint(paths[-1], spec, DepthNet("resnet18").state_dict())
    return paths


def test_several_checkpoints_are_compared_with_the_first(two_sets: Path, checkpoints: list[Path], tmp_path: Path):
    options = [word for path in checkpoints for word in ("--checkpoint", str(path))]
    assert main(["evaluate", str(two_sets), *options, "-o", str(tmp_path), "--quiet", "--no-report"]) == 0
    for path in checkpoints:
        model = metrics_of(tmp_path / path.stem)["model"]
        assert model["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert model["checkpoint"] == str(path)
    comparison = json.loads((tmp_path / "new" / "comparison.json").read_text())
    old, new = (metrics_of(tmp_path / name)["scores"]["image"]["metric"]["mean"]["all"] for name in ("old", "new"))
    found = comparison["differences"]["metric"]["abs_rel"]
    assert (found["first"], found["second"]) == pytest.approx((old["abs_rel"], new["abs_rel"]))
    assert found["difference"] == pytest.approx(new["abs_rel"] - old["abs_rel"])
    assert found["low"] <= found["difference"] <= found["high"]


def test_a_result_does_not_differ_from_itself(output: Path, capsys: pytest.CaptureFixture[str]):
    metrics = str(output / "metrics.json")
    assert main(["evaluate", "--compare", metrics, metrics, "--json"]) == 0
    differences = json.loads(capsys.readouterr().out)["differences"]
    assert all(d["difference"] == d["low"] == d["high"] == 0 for one in differences.values() for d in one.values())


def test_results_that_were_measured_differently_are_compared_with_a_warning(
    two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folders = (tmp_path / "near", tmp_path / "far", tmp_path / "other")
    for folder, options in zip(folders, ((), ("--constant-depth", "3"), ("--lidar-tolerance", "0.2")), strict=True):
        score(folder, two_sets, *CONSTANT, *options)
    near, far, other = (str(folder / "metrics.json") for folder in folders)
    capsys.readouterr()
    assert main(["evaluate", "--compare", near, far]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "too few sets to say" in captured.out
    assert " different" not in captured.out
    assert main(["evaluate", "--compare", near, other]) == 0
    assert "were measured differently (lidar_tolerance)" in capsys.readouterr().err

    content = json.loads(Path(far).read_text())
    content["recordings"][0]["lidar"] = [
        "/surround_depth/points"
    ]  # what was found before colours told a camera's cloud
    Path(far).write_text(json.dumps(content))
    assert main(["evaluate", "--compare", near, far]) == 0
    name = content["recordings"][0]["name"]
    assert f"were measured differently (lidar of {name})" in capsys.readouterr().err


def test_results_of_different_limits_are_not_compared(
    output: Path, two_sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    score(tmp_path, two_sets, *CONSTANT, "--max-depth", "60")
    capsys.readouterr()
    assert main(["evaluate", "--compare", str(output / "metrics.json"), str(tmp_path / "metrics.json")]) == 1
    assert "max_depth=60" in capsys.readouterr().err


def test_a_file_that_is_no_result_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "other.json").write_text('{"a": 1}')
    assert main(["evaluate", "--compare", str(tmp_path / "other.json"), str(tmp_path / "other.json")]) == 1
    assert "other.json: not a metrics.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["drive", "--compare", "a", "b"], "--compare takes two"),
        (["--untrained"], "required: BAG"),
        (["drive", "--width", "96"], "for --untrained only"),
        (["drive", "--untrained", "--min-depth", "80"], "must be below"),
        (["drive", "--untrained", "--workers", "0"], "at least 1"),
        (["drive", "--untrained", "--lidar", "/a", "--no-lidar"], "not allowed"),
    ],
)
def test_wrong_use_is_refused_with_the_reason(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", *arguments])
    assert ended.value.code == 2
    assert text in capsys.readouterr().err
