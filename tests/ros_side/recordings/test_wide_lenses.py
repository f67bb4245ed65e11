# SPDX-License-Identifier: Apache-2.0
"""Lenses that one picture cannot show: virtual cameras in every command, from one image topic, decoded once."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("embreex", reason="worlds need embreex")

from fisheye_drive import HEIGHT, LENS_DEG, VIEWS, WIDTH, fisheye_rig, fisheye_spec, record_fisheyes

from cvcdepth_core.errors import RigError
from cvcdepth_core.refinement.mounts import RefinedMounts
from cvcdepth_core.rig.calibration import calibration_from_fields
from cvcdepth_core.rig.poses import pose_from_quaternion
from cvcdepth_core.rig.rig_file import PoseEntry, RigLayout, load_rig_layout, save_rig_layout
from cvcdepth_core.rig_health.overlap_monitor import OverlapMonitor
from cvcdepth_core.scoring.references import constant_depth
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction, evaluate_objective
from cvcdepth_core.worlds.drive import SimulatedDrive
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import open_evaluation
from cvcdepth_ros.messages import conversion
from cvcdepth_ros.recordings.compared_pictures import turned_layout
from cvcdepth_ros.recordings.replay import DepthReplay, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.surround_sets import set_estimation
from cvcdepth_ros.training_data.index import build_index
from cvcdepth_ros.training_data.sample_choice import Sample
from cvcdepth_ros.training_data.samples import SampleReader

NAMES = [lens + view for lens in ("ahead", "port") for view in VIEWS]
SMALL = ("--untrained", "--height", "64", "--width", "96")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_fisheyes(tmp_path_factory.mktemp("fisheyes") / "drive")


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The cameras for which an image was decoded."""
    cameras: list[str] = []
    real = conversion.picture_from_message

    def counting(message: object, camera: str, *how: object) -> object:
        cameras.append(camera)
        return real(message, camera, *how)

    monkeypatch.setattr(set_estimation, "picture_from_message", counting)
    return cameras


def messages(folder: Path, topic: str) -> list:
    with open_recording(folder) as recording:
        return [recording.deserialize(message) for message in recording.messages([topic])]


def test_wide_lenses_are_found_as_three_cameras_each(drive: Path):
    with open_recording(drive) as recording:
        layout = RecordedRig.from_recording(recording).layout
    given = {camera.name: camera for camera in fisheye_rig().cameras}
    assert sorted(layout.names) == NAMES
    for camera in layout.cameras:
        lens = given[camera.name[:-2]]
        assert (camera.image_topic, camera.frame_id) == (lens.image_topic, lens.frame_id)
        assert camera.calibration.k == lens.calibration.k
        assert camera.view.hfov == pytest.approx(70)
    assert layout.names[0] == "ahead_m"


def test_each_image_is_decoded_once_for_all_views(drive: Path, decoded: list[str]):
    with open_recording(drive) as recording:
        replay = SurroundReplay(RecordedRig.from_recording(recording), MatchingSettings())
        sets = list(DepthReplay(replay, constant_depth(replay.rig, 5.0, 64, 96)).sets())
    assert len(decoded) == 2 * len(sets) == 2 * 4
    assert all(estimated.result.present.all() for estimated in sets)


def test_every_view_has_outputs_with_its_own_frame_and_place(drive: Path, tmp_path: Path):
    assert main(["run", str(drive), "-o", str(tmp_path / "depth"), *SMALL]) == 0
    (transforms,) = messages(tmp_path / "depth", "/tf_static")
    links = {link.child_frame_id: link.transform for link in transforms.transforms}
    with open_recording(drive) as recording:
        rig = {camera.name: camera for camera in RecordedRig.from_recording(recording).layout.complete().cameras}
    for name in NAMES:
        frame = f"{name}_optical_frame" if not name.endswith("_m") else f"{name[:-2]}_lens"
        depth = messages(tmp_path / "depth", f"/surround_depth/{name}/depth/image_rect")
        assert len(depth) == 4
        assert {image.header.frame_id for image in depth} == {frame}
        (info, *_) = messages(tmp_path / "depth", f"/surround_depth/{name}/depth/camera_info")
        view = np.degrees(2 * np.arctan(info.width / 2 / info.k[0]))
        assert view == pytest.approx(70, abs=0.2)
        found = links[frame]
        pose = pose_from_quaternion(
            [getattr(found.translation, axis) for axis in "xyz"], [getattr(found.rotation, axis) for axis in "xyzw"]
        )
        np.testing.assert_allclose(pose, rig[name].base_T_camera, atol=1e-6)


def test_rig_writes_what_is_found(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main(["rig", str(drive), "-o", str(tmp_path / "rig.yaml"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {camera["lens_degrees"] for camera in told["cameras"]} == {LENS_DEG}
    with open_recording(drive) as recording:
        found = RecordedRig.from_recording(recording)
        given = RecordedRig.from_recording(recording, load_rig_layout(tmp_path / "rig.yaml"))
    assert given.layout.cameras == found.layout.cameras
    assert any("ahead: shown by ahead_l, ahead_m, ahead_r" in note for note in found.notes())


VIEW_OPTIONS = {
    "one angle for all": (["--view", "100"], {"ahead": 100.0, "port": 100.0}),
    "one of them": (["--view", "port=80"], {"ahead_l": 70.0, "ahead_m": 70.0, "ahead_r": 70.0, "port": 80.0}),
    "a part in two": (
        ["--view", "130", "--view", "port=90", "--anchor", "ahead"],
        {"ahead_l": 75.0, "ahead_r": 75.0, "port": 90.0},
    ),
    "the whole lens": (["--view", "90", "--view", "lens"], dict.fromkeys(NAMES, 70.0)),
}


@pytest.mark.parametrize(("options", "views"), VIEW_OPTIONS.values(), ids=VIEW_OPTIONS)
def test_rig_takes_as_much_of_each_lens_as_is_asked_for(options: list, views: dict, drive: Path, tmp_path: Path):
    assert main(["rig", str(drive), "-o", str(tmp_path / "rig.yaml"), *options]) == 0
    layout = load_rig_layout(tmp_path / "rig.yaml")
    assert layout.anchor == next(name for name in ("ahead", "ahead_m", "ahead_l") if name in layout.names)
    assert {camera.name: camera.view.hfov for camera in layout.cameras} == {
        name: pytest.approx(hfov) for name, hfov in views.items()
    }


BAD_OPTIONS = {
    "wider than the lens": ("port=180", "view 180: camera port has a lens of 170.0 degrees"),
    "no such camera": ("left=90", "view left=90: no camera is called left; there are ahead, port"),
    "no number": ("wide", "view wide: want degrees, or 'lens'"),
}


@pytest.mark.parametrize(("option", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_an_impossible_view_is_refused(
    option: str, message: str, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    assert main(["rig", str(drive), "-o", str(tmp_path / "rig.yaml"), "--view", option]) != 0
    assert message in capsys.readouterr().err
    assert not (tmp_path / "rig.yaml").exists()


def test_check_tells_how_much_of_each_lens_is_used(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    main(["check", str(drive), "--json"])
    found = {check["name"]: check for check in json.loads(capsys.readouterr().out)["recordings"][0]["checks"]}
    assert found["lenses"]["status"] == "passed"
    assert "170 degrees by ahead_l, ahead_m, ahead_r" in found["lenses"]["finding"]
    save_rig_layout(tmp_path / "narrow.yaml", fisheye_rig())
    main(["check", str(drive), "--rig", str(tmp_path / "narrow.yaml"), "--json"])
    found = {check["name"]: check for check in json.loads(capsys.readouterr().out)["recordings"][0]["checks"]}
    assert found["lenses"]["status"] == "warning"
    assert "ahead: lens 170, used 112 degrees, overlap 52 of" in found["lenses"]["finding"]
    assert "--view lens" in found["lenses"]["remedy"]


def test_views_are_trained_on_and_what_the_lens_does_not_see_is_masked(drive: Path, decoded: list[str]):
    index = build_index(drive, MatchingSettings())
    reader = SampleReader([index], [], 64, 96, RecordingsConfig(cache_mb=0))
    pictures = reader.pictures(0, 1)
    assert pictures.shape == (6, 64, 96, 3)
    assert len(decoded) == 2
    assert len({picture.tobytes() for picture in pictures}) == 6
    pairs = {(reader.rigs[0].names[a], reader.rigs[0].names[b]) for a, b in reader.rigs[0].pairs}
    assert {("ahead_l", "ahead_m"), ("ahead_l", "port_m")} <= pairs


@pytest.mark.parametrize("corrected", [False, True])
def test_views_of_one_lens_have_no_baseline_and_are_trained_on_all_the_same(drive: Path, corrected: bool):
    index = build_index(drive, MatchingSettings())
    reader = SampleReader([index], [Sample(0, 1, 0, 2)], 64, 96, RecordingsConfig(cache_mb=0))
    columns = [column for column in reader[0][1:6] if column is not None]
    batch = reader.rigs[0].batch(*(torch.from_numpy(column[None]) for column in columns))
    disparity = torch.rand(1, 6, 1, 64, 96).requires_grad_()
    motions = torch.eye(4).expand(1, 2, 6, 4, 4).clone()
    motions[..., 2, 3] = 0.3
    prediction = Prediction(disparity, 2 + 10 * disparity, motions)
    value = evaluate_objective(batch, prediction, ObjectiveConfig(corrected=corrected))
    (gradient,) = torch.autograd.grad(value.loss, disparity)
    assert torch.isfinite(value.per_sample).all()
    assert torch.isfinite(gradient).all()
    assert {"spatial", "depth_consistency"} <= value.terms.keys()


def test_views_of_one_lens_are_no_evidence_of_its_mount(drive: Path):
    with open_recording(drive) as recording:
        rig = RecordedRig.from_recording(recording).layout.complete()
    assert {(a[:-2], b[:-2]) for a, b in OverlapMonitor(rig).pairs()} <= {("ahead", "port"), ("port", "ahead")}


def test_views_of_one_lens_are_turned_together(drive: Path):
    with open_recording(drive) as recording:
        layout = RecordedRig.from_recording(recording).layout
    rig = layout.complete()
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, 0.02]))
    poses = np.stack([camera.base_T_camera for camera in rig.cameras])
    turned = poses.copy()
    for i, name in enumerate(rig.names):
        if name in ("port_l", "port_m"):
            turned[i, :3, :3] = turn @ poses[i, :3, :3]
    turns = np.array([[np.nan] * 3 if name == "port_r" else [0.0] * 3 for name in rig.names])
    found = turned_layout(layout, RefinedMounts(turned, turns, ()))
    after = {
        camera.name: camera.base_T_camera for camera in RigLayout.model_validate(found.model_dump()).complete().cameras
    }
    for i, name in enumerate(rig.names):
        wanted = turn @ poses[i, :3, :3] if name.startswith("port") else poses[i, :3, :3]
        np.testing.assert_allclose(after[name][:3, :3], wanted, atol=1e-9)
        np.testing.assert_allclose(after[name][:3, 3], poses[i, :3, 3], atol=1e-9)


def test_a_lens_whose_views_share_nothing_but_with_each_other_teaches_no_scale(drive: Path, tmp_path: Path):
    alone = fisheye_rig(cameras=(("ahead", 0.0),))
    folder = record_fisheyes(tmp_path / "alone", alone, sets=2)
    with pytest.raises(RigError, match=r"camera ahead_\w and ahead_\w and ahead_\w: shares no view with another"):
        build_index(folder, MatchingSettings())


def test_evaluate_scores_every_view_against_the_lidar(drive: Path, tmp_path: Path):
    options = ("--predictor", "constant", "--height", "64", "--width", "96", "--no-report", "--quiet")
    assert main(["evaluate", str(drive), "-o", str(tmp_path / "out"), *options]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert sorted(metrics["recordings"][0]["cameras"]) == NAMES


def test_the_true_depth_of_a_view_is_that_of_a_pinhole_camera_in_its_place(tmp_path: Path):
    lens = fisheye_rig(cameras=(("ahead", 0.0),))
    folder = record_fisheyes(tmp_path / "fisheye", lens, sets=1, truth="depth")
    job = EvaluationJob("drive", str(folder), EvaluationSettings(truth="depth", predictor="constant"))
    with open_evaluation(job) as evaluation:
        (measured,) = evaluation.sets(*evaluation.window)
    for camera, truth in zip(measured.estimated.rig.cameras, measured.truth, strict=True):
        plain = {"k": camera.calibration.rectified_intrinsics.ravel().tolist(), "width": WIDTH, "height": HEIGHT}
        pinhole = lens.cameras[0].model_copy(
            update={
                "calibration": calibration_from_fields(camera.name, plain),
                "base_T_camera": PoseEntry.from_matrix(camera.base_T_camera),
            }
        )
        drive = SimulatedDrive(fisheye_spec(lens.model_copy(update={"cameras": (pinhole,)}), sets=1))
        wanted = drive.shoot(0, 0).truth.depth
        there = wanted[truth.rows, truth.columns]
        errors = abs(truth.depth / there - 1)[np.isfinite(there)]
        assert len(errors) > 500
        assert np.median(errors) < 0.02  # the raw picture's pixels are as wide as the view's
