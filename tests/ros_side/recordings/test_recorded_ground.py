# SPDX-License-Identifier: Apache-2.0
"""The ground of a recording: stated, found in its LiDAR's sweeps, or neither, and each is told."""

import json
import re
from pathlib import Path

import pytest
import recordings
from recordings import SAMPLE

from cvcdepth_core.estimator import untrained_network
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import PoseEntry, load_rig_layout, save_rig_layout
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.ground import RecordedGround, recorded_ground, with_ground
from cvcdepth_ros.recordings.rig import RecordedRig

AXLES = -0.31
"""Metres of the lane under the car in the sample's base frame, which is at its axles; the street falls to the left."""


def ground_of(path: Path, lidar: tuple[str, ...] | None = None, height: float | None = None) -> RecordedGround:
    with open_recording(path) as recording:
        recorded, ground = with_ground(RecordedRig.from_recording(recording), lidar, height)
        assert recorded.layout.ground_height == (None if ground.is_assumed else ground.height)
        return ground


def test_the_lidar_of_the_sample_shows_the_road_below_its_axles():
    ground = ground_of(SAMPLE)
    assert ground.source == "lidar"
    assert ground.height == pytest.approx(AXLES, abs=0.04)
    assert ground.told.startswith(f"ground at {ground.height:.2f} m in base_link: from LiDAR, ")
    assert ground.estimate is not None
    assert ground.estimate.uncertainty < 0.05


def test_what_is_stated_goes_before_what_is_found():
    ground = ground_of(SAMPLE, height=-0.3)
    assert (ground.height, ground.source) == (-0.3, "stated")
    assert ground.told == "ground at -0.30 m in base_link: as stated"


def test_without_a_lidar_the_pictures_show_the_road_nearly_as_well():
    ground = ground_of(SAMPLE, lidar=())
    assert ground.source == "pictures"
    assert ground.height == pytest.approx(AXLES, abs=0.1)  # a twentieth of the cameras' height
    assert "m in base_link: from pictures, " in ground.told
    assert ground.estimate is not None
    assert abs(ground.height - AXLES) < 2 * ground.estimate.uncertainty


def test_where_neither_shows_it_nothing_is_made_up_and_reasons_and_remedy_are_told(standing: Path):
    ground = ground_of(standing, lidar=())
    assert (ground.height, ground.source) == (0.0, "assumed")
    assert "not stated and was not found (no LiDAR; 0 pairs of pictures show a road" in ground.told
    assert "no motion is recorded" in ground.told
    assert "ground_height: -0.4" in ground.told


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets without motion and LiDAR."""
    path = tmp_path_factory.mktemp("standing") / "standing.mcap"
    entries = recordings.without(recordings.sample_entries(2), "/odom", "/lidar")
    return recordings.write_mcap(path, (entry for entry in entries if entry.topic != "/tf"))


def test_what_was_found_is_the_same_when_it_is_kept_and_read_again(standing: Path):
    for ground in (ground_of(SAMPLE), ground_of(SAMPLE, height=-0.3), ground_of(standing)):
        assert RecordedGround.from_json(json.loads(json.dumps(ground.to_json()))) == ground


def test_a_cloud_that_cannot_be_placed_is_no_ground_and_says_why(tmp_path: Path):
    def renamed(message):
        message.header.frame_id = "nowhere"

    topic = next(entry.topic for entry in recordings.sample_entries(1) if "PointCloud2" in entry.type)
    entries = recordings.changed(recordings.sample_entries(2), topic, renamed)
    copy = recordings.write_mcap(tmp_path / "lost.mcap", entries)
    ground = ground_of(copy)
    assert ground.is_assumed
    assert "nowhere" in ground.why_not


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    assert main(["rig", str(SAMPLE), "-o", str(path)]) == 0
    return path


def test_rig_writes_the_height_with_its_evidence(rig_file: Path):
    assert load_rig_layout(rig_file).ground_height == pytest.approx(AXLES, abs=0.04)
    comment = [line for line in rig_file.read_text().splitlines() if line.startswith("# ground at")]
    assert len(comment) == 1
    assert "from LiDAR" in comment[0]
    with open_recording(SAMPLE) as recording:
        recorded = RecordedRig.from_recording(recording, load_rig_layout(rig_file))
        assert recorded_ground(recorded).source == "stated"


def test_rig_takes_the_height_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["rig", str(SAMPLE), "-o", str(tmp_path / "r.yaml"), "--ground-height", "-0.5", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["ground_height"] == load_rig_layout(tmp_path / "r.yaml").ground_height == -0.5
    assert printed["ground"]["source"] == "stated"


@pytest.fixture(scope="module")
def told_its_rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a network that is told its rig, with random weights."""
    spec = DepthModelSpec(
        network="rig_conditioned", encoder="efficientnet_lite0", height=64, width=96, min_depth=0.4, max_depth=250.0
    )
    path = tmp_path_factory.mktemp("told") / "told.safetensors"
    save_checkpoint(path, spec, untrained_network(spec).state_dict())
    return path


def test_evaluate_and_run_look_for_the_ground_where_the_network_is_told_its_rig(
    told_its_rig: Path, rig_file: Path, tmp_path: Path
):
    network = ("--checkpoint", str(told_its_rig), "--duration", "0.25", "--quiet", "--backend", "torch_eager")
    assert main(["evaluate", str(SAMPLE), "-o", str(tmp_path / "found"), "--no-report", *network]) == 0
    stated = ("--rig", str(rig_file))
    assert main(["evaluate", str(SAMPLE), "-o", str(tmp_path / "stated"), "--no-report", *network, *stated]) == 0
    found, stated_there = (json.loads((tmp_path / n / "metrics.json").read_text()) for n in ("found", "stated"))
    ground = found["recordings"][0]["ground"]
    assert (ground["source"], ground["told_to_network"]) == ("lidar", True)
    assert stated_there["recordings"][0]["ground"]["source"] == "stated"
    assert found["scores"] == stated_there["scores"]
    assert main(["run", str(SAMPLE), "-o", str(tmp_path / "run"), *network]) == 0
    assert json.loads((tmp_path / "run" / "run.json").read_text())["ground"]["height"] == ground["height"]


def test_a_network_that_is_told_its_rig_warns_once_where_the_ground_is_not_known(
    told_its_rig: Path, standing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    network = ("--checkpoint", str(told_its_rig), "--quiet", "--no-report")
    assert main(["evaluate", str(standing), "-o", str(tmp_path / "out"), *network]) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if "height of the ground" in line]
    assert len(warnings) == 1
    assert "cvcdepth rig BAG" in warnings[0]


def check_of(capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, object]:
    assert main(["check", str(SAMPLE), "--quiet", "--json", *options]) == 0
    (recording,) = json.loads(capsys.readouterr().out)["recordings"]
    (found,) = (check for check in recording["checks"] if check["name"] == "ground")
    assert isinstance(found, dict)
    return found


def test_check_compares_what_is_stated_with_what_is_found_and_names_the_remedy(
    rig_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert check_of(capsys, "--rig", str(rig_file))["status"] == "passed"
    unstated = check_of(capsys)
    assert unstated["status"] == "passed"
    assert "no height of the ground in base_link is stated; found at -0.3" in str(unstated["finding"])
    assert "cvcdepth rig BAG" in str(unstated["remedy"])
    for height, words in ((0.0, "16% too near"), (-0.9, "too far")):
        wrong = tmp_path / "wrong.yaml"
        wrong.write_text(rig_file.read_text().replace("ground_height:", f"ground_height: {height} #"))
        found = check_of(capsys, "--rig", str(wrong))
        assert found["status"] == "warning"
        assert words in str(found["finding"])
        assert "ground_height: -0.30" in str(found["remedy"])
    skipped = check_of(capsys, "--no-lidar")
    assert skipped["status"] == "skipped"
    assert "ground_height: -0.4" in str(skipped["remedy"])


def test_check_names_focal_lengths_where_pictures_and_lidar_disagree(
    rig_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    longer = load_rig_layout(rig_file)
    cameras = [
        camera.model_copy(update={"calibration": with_focal_length(camera.calibration, 1.2)})
        for camera in longer.cameras
    ]
    save_rig_layout(tmp_path / "longer.yaml", longer.model_copy(update={"cameras": tuple(cameras)}))
    skipped = ("--skip", "mounts", "--skip", "odometry")
    right = check_of(capsys, "--rig", str(rig_file), "--pictures", *skipped)
    assert right["status"] == "passed"
    assert "from pictures, " in str(right["finding"])
    wrong = check_of(capsys, "--rig", str(tmp_path / "longer.yaml"), "--pictures", *skipped)
    assert wrong["status"] == "warning"
    assert re.search(r"by the pictures the cameras are 0\.(7[5-9]|8\d) times as high", str(wrong["finding"]))
    assert "calibrate the cameras (focal lengths off by +2" in str(wrong["remedy"])


def test_check_names_a_rig_whose_cameras_look_at_the_sky(
    rig_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    layout = load_rig_layout(rig_file)
    up = PoseEntry(translation=(0.8, 0.0, 1.6), rotation=(0.0, 0.0, 0.0, 1.0))
    cameras = tuple(camera.model_copy(update={"base_T_camera": up}) for camera in layout.cameras)
    save_rig_layout(tmp_path / "sky.yaml", layout.model_copy(update={"cameras": cameras}))
    main(["check", str(SAMPLE), "--quiet", "--json", "--rig", str(tmp_path / "sky.yaml")])
    (recording,) = json.loads(capsys.readouterr().out)["recordings"]
    (found,) = (check for check in recording["checks"] if check["name"] == "ground")
    assert found["status"] == "warning"
    assert "none looks below the horizon by its transform, so none sees the ground" in found["finding"]
    assert "transforms" in found["remedy"]


def with_focal_length(calibration: Calibration | None, factor: float) -> Calibration:
    assert calibration is not None
    scaled = [factor if i in (0, 4) else 1.0 for i in range(9)]
    k = tuple(value * by for value, by in zip(calibration.k, scaled, strict=True))
    return calibration.model_copy(update={"k": k, "p": (0.0,) * 12})


def test_flat_ground_is_scored_at_the_height_that_was_found(tmp_path: Path):
    options = ("--predictor", "ground_plane", "--height", "64", "--width", "96", "--duration", "0.25", "--no-report")
    errors = {}
    for name, more in {"found": (), "0": ("--ground-height", "0"), "axles": ("--ground-height", str(AXLES))}.items():
        assert main(["evaluate", str(SAMPLE), "-o", str(tmp_path / name), "--quiet", *options, *more]) == 0
        result = json.loads((tmp_path / name / "metrics.json").read_text())
        errors[name] = result["scores"]["image"]["metric"]["mean"]["all"]["abs_rel"]
    assert errors["found"] == pytest.approx(errors["axles"], rel=0.02)
    assert abs(errors["found"] / errors["0"] - 1) > 0.05
