# SPDX-License-Identifier: Apache-2.0
"""Depth images beside the pictures as ground truth: exact for every lens, sky and movers apart, and refused by name."""

from pathlib import Path

import numpy as np
import pytest
from recordings import SAMPLE
from simple_worlds import LENSES, short_drive, two_cameras

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import MeasuredSet, open_evaluation
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.true_depth import RecordedDepthImages, edges
from cvcdepth_ros.simulation.recording import record
from cvcdepth_ros.simulation.set_messages import Form

pytest.importorskip("embreex", reason="worlds need embreex")

SETTINGS = {"truth": "depth", "predictor": "ground_plane", "height": 32, "width": 64}


@pytest.fixture(scope="module", params=["no distortion", "plumb_bob", "equidistant"])
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "drive"
    spec = short_drive().model_copy(update={"layout": two_cameras(calibration=LENSES[request.param]), "seconds": 0.2})
    record(spec, Form(truth="all"), path, 1)
    return path


def measured(drive: Path) -> list[MeasuredSet]:
    job = EvaluationJob("drive", str(drive), EvaluationSettings.model_validate(SETTINGS))
    with open_evaluation(job) as evaluation:
        return list(evaluation.sets(*evaluation.window))


def test_every_picture_has_dense_truth_that_lies_on_the_lidars_points(drive: Path):
    job = EvaluationJob("drive", str(drive), EvaluationSettings.model_validate(SETTINGS | {"truth": "lidar"}))
    with open_evaluation(job) as evaluation:
        by_lidar = list(evaluation.sets(*evaluation.window))
    found = measured(drive)
    assert len(found) == len(by_lidar) == 2
    errors = []
    for dense, sparse in zip(found, by_lidar, strict=True):
        for ours, theirs in zip(dense.truth, sparse.truth, strict=True):
            assert len(ours) > 0.3 * ours.height * ours.width
            there = ours.image()[theirs.rows, theirs.columns]
            errors.append(np.abs(there / theirs.depth - 1))
    joined = np.concatenate(errors)
    assert np.isfinite(joined).sum() > 100
    assert np.nanmedian(joined) < 0.02  # a pixel of these pictures is a degree wide


def test_sky_movers_and_edges_are_told_apart(drive: Path):
    truths = [truth for one in measured(drive) for truth in one.truth]
    assert sum(len(truth.sky) for truth in truths) > 200
    assert sum(int(truth.parts["moving"].sum()) for truth in truths) > 5
    for truth in truths:
        assert 0 < truth.parts["edges"].mean() < 0.8
        assert not set(map(tuple, truth.sky.tolist())) & set(
            zip(truth.rows.tolist(), truth.columns.tolist(), strict=True)
        )


def test_scores_have_groups_for_them_and_say_how_much_of_the_sky_is_far(drive: Path):
    job = EvaluationJob("drive", str(drive), EvaluationSettings.model_validate(SETTINGS))
    with open_evaluation(job) as evaluation:
        found = evaluation.scores()
    mean = found.scores.summary().mean
    assert mean["edges"].truth + mean["moving"].truth < mean["all"].truth
    assert mean["edges"].metrics["abs_rel"] > 0
    sky = found.summary["sky"]
    assert 0 <= sky["far"] <= sky["pixels"]
    assert sky["pixels"] > 200


def test_a_step_of_depth_and_the_skys_outline_are_edges_and_a_slanted_plane_is_none():
    depth = np.tile(np.linspace(5.0, 6.0, 40, dtype=np.float32), (20, 1))
    assert not edges(depth).any()
    depth[:10] = np.inf
    found = edges(depth)
    assert found[8:12].all()
    assert not found[:7].any()
    assert not found[13:].any()


def test_part_of_the_pixels_keeps_what_is_known_of_them():
    truth = SparseDepth(
        np.arange(3), np.arange(3), np.array([1.0, 2, 3]), 4, 4, {"moving": np.array([True, False, True])}
    )
    assert truth[np.array([False, True, True])].parts["moving"].tolist() == [False, True]


def test_a_recording_without_true_depth_is_refused_with_topic_and_remedy(tmp_path: Path):
    spec = short_drive().model_copy(update={"seconds": 0.1})
    record(spec, Form(truth="none"), tmp_path / "plain", 1)
    with open_recording(tmp_path / "plain") as recording:
        recorded = RecordedRig.from_recording(recording)
        with pytest.raises(
            RecordingError, match=r"no true depth on /camera/front/truth/depth, .*as `simulate` records"
        ):
            RecordedDepthImages(recorded)


def test_lidar_options_have_no_meaning_with_true_depth(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["evaluate", str(SAMPLE), "--truth", "depth", "--no-lidar", "-o", str(tmp_path)])
    assert "--truth depth: depth images are the truth, so --lidar and --no-lidar" in capsys.readouterr().err
