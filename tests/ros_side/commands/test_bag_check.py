# SPDX-License-Identifier: Apache-2.0
"""`bag_replay check`: each check passes on the sample, and fails, with its remedy, on a sample spoiled on purpose."""

import itertools
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recordings
import yaml
from recordings import CAMERAS, SAMPLE, Entry
from repository import ROOT

from cvcdepth_core.refinement.mounts import RefinedMounts
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_core.training.config import load_training_config
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.checks import CHECKS, CheckContext, CheckOptions, run_checks
from cvcdepth_ros.recordings.compared_pictures import ComparedPictures
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import build_index
from cvcdepth_ros.training_data.sample_choice import find_samples

FRONT, LEFT = "/camera/front/image_raw/compressed", "/camera/left/image_raw/compressed"
MS = 1_000_000
FULL = ROOT.parent / "shared" / "data" / "pandaset_002"

Checks = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def sample() -> list[Entry]:
    return recordings.sample_entries()


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    assert main(["rig", str(SAMPLE), "-o", str(path)]) == 0
    return path


@pytest.fixture
def check(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Run the command on a recording, or on messages; return the checks by name. The exit code must fit them."""

    def run(recording: Path | Iterable[Entry], *options: str) -> Checks:
        if not isinstance(recording, Path):
            recording = recordings.write_rosbag2(tmp_path / "spoiled", recording)
        skipped = [] if "--skip" in options else ["--skip", "places"]  # the one that costs a second
        code = main(["check", str(recording), "--json", *skipped, *options])
        out, err = capsys.readouterr()
        (result,) = json.loads(out)["recordings"]
        failed = [found["name"] for found in result["checks"] if found["status"] == "failed"]
        assert code == (1 if failed else 0)
        assert all(name in err for name in failed)
        for found in result["checks"]:
            assert found["remedy"] or found["status"] in ("passed", "skipped")
        return {found["name"]: found for found in result["checks"]}

    return run


def statuses(checks: Checks) -> dict[str, str]:
    return {name: found["status"] for name, found in checks.items()}


PASSED = dict.fromkeys(CHECKS, "passed") | {
    "ego masks": "skipped",
    "places": "skipped",
    "training": "warning",  # a second holds too little out for a verdict
    "pose network": "skipped",
    "mounts": "skipped",
    "odometry": "skipped",
}


def test_the_sample_passes_and_the_values_are_its_own(check):
    checks = check(SAMPLE)
    assert statuses(checks) == PASSED
    assert [found["number"] for found in checks.values()] == list(range(1, len(CHECKS) + 1))
    sets = checks["sets"]["values"]
    assert (sets["sets"], sets["first"], sets["last"]) == (10, "back", "right")
    assert sets["spread"] == pytest.approx(0.081, abs=0.001)
    overlaps = checks["overlaps"]["values"]["degrees"]
    assert overlaps["back - left"] == pytest.approx(4, abs=1)
    assert overlaps["front_left - left"] == pytest.approx(58, abs=1)
    seen = checks["LiDAR"]["values"]["/lidar/points"]
    assert seen["front"] == pytest.approx(52 / 360, abs=0.05)
    assert all(seen[name] == pytest.approx(92 / 360, abs=0.05) for name in CAMERAS if name != "front")
    motion = checks["motion"]["values"]
    assert motion["moving_share"] == 1
    assert motion["metres"] / motion["seconds"] == pytest.approx(3.7, abs=0.5)


@pytest.mark.skipif(not FULL.exists(), reason="the full recording is not shipped")
def test_the_full_recording_passes(check):
    checks = check(FULL)
    assert statuses(checks) == PASSED | {"training": "passed"}
    assert checks["sets"]["values"]["sets"] == 40
    assert checks["training"]["values"] == {"samples": 26, "held_out_sets": 10, "sets": 40}


def test_the_rig_file_of_the_sample_passes_too(check, rig_file: Path):
    assert statuses(check(SAMPLE, "--rig", str(rig_file))) == PASSED


def test_a_camera_without_camera_info_is_a_warning_and_with_a_rig_file_none(check, sample, rig_file: Path, tmp_path):
    path = recordings.write_rosbag2(tmp_path / "bag", recordings.without(sample, "/camera/left/camera_info"))
    found = check(path)["cameras"]
    assert (found["status"], found["values"]["without_camera_info"]) == ("warning", [LEFT])
    assert "5 found" in found["finding"]
    assert check(path, "--rig", str(rig_file))["cameras"]["status"] == "passed"


def test_a_camera_without_images_fails(check, sample):
    found = check(recordings.without(sample, LEFT))["cameras"]
    assert found["status"] == "failed"
    assert found["values"]["without_images"] == ["/camera/left/camera_info"]


def test_a_topic_of_the_rig_file_that_is_not_recorded_fails(check, sample, rig_file: Path):
    checks = check(recordings.without(sample, LEFT), "--rig", str(rig_file))
    assert checks["cameras"]["status"] == checks["sets"]["status"] == "failed"
    assert f"camera left: no topic {LEFT}" in checks["cameras"]["finding"]
    assert "no image of left" in checks["sets"]["finding"]


@pytest.mark.parametrize("field", ["image_topic", "camera_info_topic"])
def test_a_topic_of_the_rig_file_that_carries_something_else_fails(field, check, rig_file: Path, tmp_path: Path):
    rig = yaml.safe_load(rig_file.read_text())
    left = next(camera for camera in rig["cameras"] if camera["name"] == "left")
    left.pop("calibration")
    left[field] = "/odom"
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    found = check(SAMPLE, "--rig", str(tmp_path / "rig.yaml"))["cameras"]
    assert found["status"] == "failed"
    assert "camera left: /odom carries nav_msgs/msg/Odometry" in found["finding"]


def test_without_cameras_the_other_checks_say_so(check, sample):
    checks = check(recordings.without(sample, "/camera"))
    assert statuses(checks) == {"cameras": "failed", "LiDAR": "skipped", "stamps": "passed"} | dict.fromkeys(
        CHECKS.keys() - {"cameras", "LiDAR", "stamps"}, "skipped"
    )


def cut_camera_infos(sample: list[Entry], damaged: slice) -> list[Entry]:
    numbers = [i for i, entry in enumerate(sample) if entry.topic == "/camera/left/camera_info"][damaged]
    return [e._replace(cdr=e.cdr[:40]) if i in numbers else e for i, e in enumerate(sample)]


def test_one_camera_info_that_cannot_be_read_costs_itself(check, sample):
    assert check(cut_camera_infos(sample, slice(1)))["cameras"]["status"] == "passed"


def test_camera_infos_none_of_which_can_be_read_fail(check, sample):
    found = check(cut_camera_infos(sample, slice(None)))["cameras"]
    assert found["status"] == "failed"
    assert "/camera/left/camera_info at" in found["finding"]


def test_an_uncalibrated_camera_fails(check, sample):
    def uncalibrate(message: Any) -> None:
        message.k = np.zeros(9)

    checks = check(recordings.changed(sample, "/camera/left/camera_info", uncalibrate))
    assert checks["camera_info"]["status"] == "failed"
    assert "camera left" in checks["camera_info"]["finding"]
    assert checks["overlaps"]["status"] == checks["LiDAR"]["status"] == "skipped"


def test_a_calibration_of_another_size_fails(check, sample):
    def double(message: Any) -> None:
        message.width, message.height = 1920, 1080

    found = check(recordings.changed(sample, "/camera/left/camera_info", double))["camera_info"]
    assert found["status"] == "failed"
    assert "camera left: images of 960x540, but the calibration is for 1920x1080" in found["finding"]


def test_a_missing_transform_fails(check, sample):
    def forget(message: Any) -> None:
        message.transforms = [link for link in message.transforms if not link.child_frame_id.startswith("right")]

    found = check(recordings.changed(sample, "/tf_static", forget))["transforms"]
    assert found["status"] == "failed"
    assert "right_camera_optical_frame" in found["finding"]


def test_transforms_that_contradict_each_other_fail(check, sample):
    def second_parent(message: Any) -> None:
        message.transforms[1].child_frame_id = message.transforms[0].child_frame_id
        message.transforms[1].header.frame_id = "map"

    found = check(recordings.changed(sample, "/tf_static", second_parent))["transforms"]
    assert found["status"] == "failed"
    assert "two parents" in found["finding"]


def test_an_unknown_base_frame_fails_and_the_known_ones_are_told(check):
    found = check(SAMPLE, "--base-frame", "base_footprint")["transforms"]
    assert (found["status"], found["finding"]) == ("failed", "no frame is called base_footprint")
    assert "base_link" in found["remedy"]


def test_no_transforms_at_all_fail_unless_the_rig_file_has_them(check, sample, rig_file: Path, tmp_path: Path):
    path = recordings.write_rosbag2(tmp_path / "bag", recordings.without(sample, "/tf_static"))
    assert check(path)["transforms"]["finding"] == "nothing on /tf_static"
    assert check(path, "--rig", str(rig_file))["transforms"]["status"] == "passed"


def test_swapped_stamps_fail(check, sample):
    swapped = {4: 100 * MS, 5: -100 * MS}
    found = check(recordings.restamped(sample, FRONT, lambda n, stamp: stamp + swapped.get(n, 0)))["stamps"]
    assert (found["status"], found["values"]["problems"]) == ("failed", {FRONT: "1 of 10 stamps step back"})


def test_a_repeated_stamp_is_a_warning_and_stamps_of_zero_fail(check, sample, tmp_path: Path):
    first = next(entry for entry in sample if entry.topic == FRONT)
    twice = recordings.write_rosbag2(tmp_path / "twice", [first, *sample])
    found = check(twice)["stamps"]
    assert (found["status"], found["values"]["problems"]) == ("warning", {FRONT: "1 of 11 stamps repeat"})
    zero = recordings.write_rosbag2(tmp_path / "zero", recordings.restamped(sample, LEFT, lambda *_: 0))
    found = check(zero)["stamps"]
    assert (found["status"], found["values"]["problems"]) == ("failed", {LEFT: "all stamps are zero"})


def test_too_narrow_a_tolerance_names_the_cameras_that_limit_it_and_the_tolerance_that_works(check):
    found = check(SAMPLE, "--tolerance", "0.05")["sets"]
    assert (found["status"], found["values"]["sets"]) == ("failed", 0)
    assert found["values"]["limited_by"] == ["back", "right"]
    assert found["values"]["proposed_tolerance"] == pytest.approx(0.085)
    again = check(SAMPLE, "--tolerance", str(found["values"]["proposed_tolerance"]))["sets"]
    assert (again["status"], again["values"]["sets"]) == ("passed", 10)
    assert "gives 10 sets" in found["remedy"]


def test_a_camera_whose_clock_differs_is_named_with_the_offset_that_works(
    check, sample, rig_file: Path, tmp_path: Path
):
    ahead = recordings.restamped(sample, LEFT, lambda _, stamp: stamp + 3_200 * MS)
    path = recordings.write_rosbag2(tmp_path / "bag", ahead)
    found = check(path)["sets"]
    assert (found["status"], found["values"]["limited_by"]) == ("failed", ["left"])
    assert found["values"]["stamp_offset"] == pytest.approx({"left": 3.2}, abs=0.002)
    rig = yaml.safe_load(rig_file.read_text())
    next(camera for camera in rig["cameras"] if camera["name"] == "left")["stamp_offset"] = 3.2
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    checks = check(path, "--rig", str(tmp_path / "rig.yaml"))
    assert checks["sets"]["values"]["sets"] == 10
    assert checks["LiDAR"]["values"]["/lidar/points"] == check(SAMPLE)["LiDAR"]["values"]["/lidar/points"]


def test_lost_images_are_a_warning_that_names_the_camera(check, sample):
    found = check(recordings.with_gap(sample, LEFT, 3, 6))["sets"]
    assert (found["status"], found["values"]["sets"], found["values"]["limited_by"]) == ("warning", 6, ["left"])
    assert "left with 6 images" in found["finding"]


def test_a_camera_that_shares_no_view_is_a_warning(check, rig_file: Path, tmp_path: Path):
    rig = yaml.safe_load(rig_file.read_text())
    rig["cameras"] = [camera for camera in rig["cameras"] if camera["name"] in ("front", "front_left", "back")]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    found = check(SAMPLE, "--rig", str(tmp_path / "rig.yaml"))["overlaps"]
    assert (found["status"], found["finding"]) == ("warning", "back shares no view with another camera")


def masked_rig(rig_file: Path, folder: Path, mask: np.ndarray) -> Path:
    """The sample's rig with a mask for its back camera."""
    layout = load_rig_layout(rig_file)
    cv2.imwrite(str(folder / "back.png"), mask)
    rig = yaml.safe_load(rig_file.read_text())
    rig["cameras"][layout.names.index("back")]["mask"] = "back.png"
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    return folder / "rig.yaml"


@pytest.mark.parametrize(
    ("first", "last", "status", "share"),
    [(432, 540, "passed", 0.2), (0, 432, "warning", 0.8), (0, 108, "warning", 0.2), (540, 540, "warning", 0.0)],
    ids=["lower fifth", "inverted", "upside down", "nothing"],
)
def test_masks_are_judged_by_what_they_take_away(first, last, status, share, check, rig_file: Path, tmp_path: Path):
    mask = np.full((540, 960), 255, np.uint8)
    mask[first:last] = 0
    found = check(SAMPLE, "--rig", str(masked_rig(rig_file, tmp_path, mask)))["ego masks"]
    assert found["status"] == status
    assert found["values"]["back"]["share"] == pytest.approx(share, abs=0.01)


def test_a_mask_of_another_size_fails(check, rig_file: Path, tmp_path: Path):
    rig = masked_rig(rig_file, tmp_path, np.full((54, 96), 255, np.uint8))
    found = check(SAMPLE, "--rig", str(rig))["ego masks"]
    assert found["status"] == "failed"
    assert "96x54" in found["finding"]


def test_without_a_lidar_there_is_a_warning_and_one_that_is_named_must_be_there(check, sample, tmp_path: Path):
    path = recordings.write_rosbag2(tmp_path / "bag", recordings.without(sample, "/lidar"))
    assert check(path)["LiDAR"]["status"] == "warning"
    for topic in ("/lidar/points", "/odom"):
        found = check(path, "--lidar", topic)["LiDAR"]
        assert (found["status"], found["values"]["missing"]) == ("failed", [topic])


def test_a_lidar_without_transform_or_without_coordinates_fails(check, sample, tmp_path: Path):
    def elsewhere(message: Any) -> None:
        message.header.frame_id = "roof"

    def nameless(message: Any) -> None:
        message.fields[0].name = "range"

    for number, (change, reason) in enumerate([(elsewhere, "'roof' is unknown"), (nameless, "no field x")]):
        changed = recordings.changed(sample, "/lidar/points", change)
        found = check(recordings.write_rosbag2(tmp_path / f"bag{number}", changed))["LiDAR"]
        assert found["status"] == "failed"
        assert reason in found["finding"]


def test_a_cloud_that_is_no_truth_is_a_warning_beside_a_lidar_that_is(check, sample, tmp_path: Path):
    def lift(message: Any) -> None:
        message.header.frame_id = "roof"

    def colour(message: Any) -> None:
        message.fields[-1].name = "rgb"

    expected = check(SAMPLE)["LiDAR"]
    reasons = {lift: "/other/points: no transform base_link <- roof", colour: "points have colours: /other/points"}
    for change, reason in reasons.items():
        other = [entry._replace(topic="/other/points") for entry in sample if entry.topic == "/lidar/points"]
        entries = sorted([*sample, *recordings.changed(other, "/other/points", change)], key=lambda e: e.log_time)
        path = recordings.write_rosbag2(tmp_path / change.__name__, entries)
        found = check(path)["LiDAR"]
        assert (found["status"], found["values"]) == ("warning", expected["values"])
        assert reason in found["finding"]
        assert check(path, "--lidar", "/lidar/points")["LiDAR"] == expected
    assert check(SAMPLE, "--no-lidar")["LiDAR"]["status"] == "skipped"


def test_a_cloud_that_came_once_before_the_part_is_a_warning_beside_a_lidar_that_is(check, sample, tmp_path: Path):
    first = next(entry for entry in sample if entry.topic == "/lidar/points")
    entries = sorted([*sample, first._replace(topic="/once")], key=lambda entry: entry.log_time)
    found = check(recordings.write_rosbag2(tmp_path / "bag", entries), "--start", "0.3")["LiDAR"]
    assert found["status"] == "warning"
    assert list(found["values"]) == ["/lidar/points"]
    assert "no sweep on /once in this part" in found["finding"]


def test_points_that_are_too_far_away_to_be_true_fail(check, sample):
    def away(message: Any) -> None:
        for link in message.transforms:
            if link.child_frame_id == "pandar64":
                link.transform.translation.x += 500.0  # straight ahead: all are in the front camera's picture

    assert check(recordings.changed(sample, "/tf_static", away))["LiDAR"]["status"] == "failed"


def test_a_standing_vehicle_fails(check, sample):
    def stand(message: Any) -> None:
        for link in message.transforms:
            link.transform.translation.x = link.transform.translation.y = link.transform.translation.z = 0.0

    found = check(recordings.changed(sample, "/tf", stand))["motion"]
    assert (found["status"], found["values"]["moving_share"]) == ("failed", 0)


def test_motion_comes_from_odometry_too_and_its_absence_is_told(check, sample, tmp_path: Path):
    def recorded_without(*topics: str) -> Path:
        kept = [entry for entry in sample if entry.topic not in topics]
        return recordings.write_rosbag2(tmp_path / f"without_{len(topics)}", kept)

    by_odometry = check(recorded_without("/tf"))["motion"]
    assert "(/odom)" in by_odometry["finding"]
    assert by_odometry["values"] == check(SAMPLE)["motion"]["values"]
    found = check(recorded_without("/tf", "/odom"))["motion"]
    assert (found["status"], found["finding"]) == ("warning", "motion unknown: neither /tf nor odometry is recorded")


def test_an_image_that_cannot_be_decoded_fails(check, sample):
    def cut(message: Any) -> None:
        message.data = message.data[:1000]

    found = check(recordings.changed(sample, LEFT, cut))["encodings"]
    assert found["status"] == "failed"
    assert "camera left: compressed image of 1000 bytes has no end" in found["finding"]


def test_an_unknown_encoding_fails(check, sample):
    def rename(message: Any) -> None:
        message.encoding = "yuv444"

    raw = recordings.with_raw_images(recordings.sample_entries(2), "bgr8")
    found = check(recordings.changed(raw, "/camera/left/image_raw", rename))["encodings"]
    assert found["status"] == "failed"
    assert "yuv444" in found["finding"]


def exchanged_poses(first: str, second: str):
    """What gives two cameras each other's place on /tf_static."""

    def exchange(message: Any) -> None:
        links = {link.child_frame_id: link for link in message.transforms}
        one, other = (links[f"{camera}_camera_optical_frame"] for camera in (first, second))
        one.transform, other.transform = other.transform, one.transform

    return exchange


@pytest.mark.parametrize("pair", [("left", "right"), ("front", "front_left"), ("right", "back")])
def test_cameras_that_were_swapped_are_named(pair, check, sample):
    swapped = recordings.changed(sample, "/tf_static", exchanged_poses(*pair))
    found = check(swapped, "--skip", "LiDAR")["places"]
    assert found["status"] == "failed"
    assert sorted(found["values"]["cameras"]) == sorted(pair)
    assert found["values"]["exchanged_error"] < 0.7 * found["values"]["error"]


def test_topics_that_were_swapped_are_named_as_well(check, sample, rig_file: Path, tmp_path: Path):
    rig = yaml.safe_load(rig_file.read_text())
    front, back = (next(c for c in rig["cameras"] if c["name"] == name) for name in ("front_left", "front_right"))
    front["image_topic"], back["image_topic"] = back["image_topic"], front["image_topic"]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    found = check(SAMPLE, "--rig", str(tmp_path / "rig.yaml"), "--skip", "LiDAR")["places"]
    assert (found["status"], sorted(found["values"]["cameras"])) == ("failed", ["front_left", "front_right"])


@pytest.mark.parametrize("recording", [SAMPLE, FULL], ids=["sample", "full"])
def test_no_exchange_explains_the_pictures_of_a_right_rig_better(recording, check):
    if not recording.exists():
        pytest.skip("the full recording is not shipped")
    found = check(recording, "--skip", "LiDAR")["places"]
    assert found["status"] == "passed"
    assert found["values"]["exchanged_error"] > 1.3 * found["values"]["error"]


def blackened(entries: Iterable[Entry], topic: str, first: int = 0) -> Iterator[Entry]:
    """The same recording, the pictures of one topic black from the `first` on."""
    number = itertools.count()

    def blacken(message: Any) -> None:
        if next(number) >= first:
            message.data = cv2.imencode(".jpg", np.full((540, 960, 3), 3, np.uint8))[1].ravel()

    return recordings.changed(entries, topic, blacken)


def test_black_pictures_fail_and_some_of_them_are_a_warning(check, sample, tmp_path: Path):
    always = recordings.write_rosbag2(tmp_path / "always", blackened(sample, LEFT))
    found = check(always)["brightness"]
    assert (found["status"], found["values"]["pictures"]) == ("failed", {"left": 3})
    late = recordings.write_rosbag2(tmp_path / "late", blackened(sample, LEFT, first=6))
    found = check(late)["brightness"]
    assert (found["status"], found["values"]["pictures"]) == ("warning", {"left": 1})


def test_a_check_can_be_left_out_but_not_one_that_there_is_not(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(SAMPLE), "--tolerance", "0.05", "--skip", "sets"]) == 0
    assert "left out as you wanted" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["check", str(SAMPLE), "--skip", "set"])
    assert "no check is called 'set'; there are cameras, " in capsys.readouterr().err


def test_damage_is_told_and_what_is_left_is_checked(check, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = recordings.cut(recordings.SAMPLE_MCAP, tmp_path / "cut.mcap")
    assert statuses(check(path)) == PASSED
    assert main(["check", str(path)]) == 0
    assert "damage" in capsys.readouterr().out


def test_the_text_numbers_every_check_and_shows_the_remedy(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(SAMPLE), "--tolerance", "0.05"]) == 1
    out, err = capsys.readouterr()
    lines = out.splitlines()
    for number, name in enumerate(CHECKS, 1):
        assert any(line.startswith(f"{number:>4}  ") and name in line for line in lines)
    assert any(line.strip() == "-> --tolerance 0.085 gives 10 sets" for line in lines)
    assert max(map(len, lines)) <= 120
    (line,) = err.splitlines()
    assert line.endswith("1 failed (sets)")


def test_every_recording_is_checked_and_one_that_cannot_be_read_is_named(tmp_path: Path, capsys):
    recordings.lone_mcap(tmp_path / "good.mcap")
    (tmp_path / "bad.mcap").write_bytes(b"no recording at all")
    assert main(["check", str(tmp_path), "--json"]) == 1
    out, err = capsys.readouterr()
    bad, good = json.loads(out)["recordings"]
    assert "begins with" in bad["unreadable"]
    assert good["counts"] == {"passed": 13, "skipped": 4, "warning": 1}
    assert "bad.mcap" in err
    assert "good.mcap" not in err


def test_pictures_tell_which_neighbours_disagree_and_the_remedy(check):
    checks = check(SAMPLE, "--pictures")
    mounts = checks["mounts"]
    assert mounts["status"] == "warning"
    assert re.match(r"neighbours disagree by [01]\.\d degrees \((front_)?right - front(_right)?\)", mounts["finding"])
    assert "rig BAG --refine" in mounts["remedy"]
    assert checks["odometry"]["finding"] == "too few sets in a row to tell: 10"


@pytest.mark.parametrize(
    ("has_odometry", "problem", "status"),
    [(True, "", "passed"), (True, "odometry has another scale", "warning"), (False, "", "skipped")],
)
def test_odometry_is_judged_by_what_the_pictures_say(has_odometry: bool, problem: str, status: str):
    with open_recording(SAMPLE) as recording:
        context = CheckContext(recording, CheckOptions(pictures=True))
        assert context.rig is not None
        nothing = RefinedMounts(np.zeros((6, 4, 4)), np.zeros((6, 3)), ())
        context.compared = ComparedPictures(context.rig, 12, nothing, problem, has_odometry, has_judged_odometry=True)
        found = CHECKS["odometry"](context)
    assert found.status == status
    assert problem in found.finding


def test_the_checks_are_there_for_other_commands():
    with open_recording(SAMPLE) as recording:
        context = CheckContext(recording, CheckOptions())
        assert CHECKS["motion"](context).status == "passed"
        assert [found.name for found in run_checks(context)] == list(CHECKS)


def config_file(path: Path, **recordings_: object) -> str:
    path.write_text(yaml.safe_dump({"base": str(ROOT / "config/training/finetune.yaml"), "recordings": recordings_}))
    return str(path)


def test_samples_and_held_out_sets_are_those_that_finetune_would_have(check, tmp_path: Path):
    training = check(SAMPLE)["training"]
    assert training["values"] == {"samples": 5, "held_out_sets": 3, "sets": 10}
    assert "motion: recorded (/tf)" in training["finding"]
    assert "promotion impossible: 3 held-out sets, 6 are needed" in training["finding"]
    half = config_file(tmp_path / "half.yaml", held_out=0.6, motion="network")
    training = check(SAMPLE, "--config", half)["training"]
    index = build_index(SAMPLE, MatchingSettings())
    samples = find_samples(index, load_training_config(half).recordings, "training")
    assert training["status"] == "passed"
    assert training["values"] == {"samples": len(samples), "held_out_sets": 6, "sets": 10}


def test_why_there_is_no_sample_is_said(check, sample, tmp_path: Path):
    far = config_file(tmp_path / "far.yaml", min_travel=9)
    finding = check(SAMPLE, "--config", far)["training"]["finding"]
    assert finding.startswith("0 samples because: no training sample in 10 sets: the vehicle moves 0.4")
    slow = recordings.write_rosbag2(tmp_path / "slow", recordings.thinned(sample, 5))
    finding = check(slow)["training"]["finding"]
    assert finding.startswith("0 samples because: no training sample in 2 sets")


def test_without_motion_samples_are_counted_by_the_pictures(check, sample):
    blind = [entry for entry in sample if entry.topic not in ("/odom", "/tf")]
    training = check(blind)["training"]
    assert training["values"] == {"samples": 5, "held_out_sets": 3, "sets": 10}
    assert "motion: pose network, for none is recorded" in training["finding"]


def test_a_pose_network_that_odometry_contradicts_is_a_warning(check, sample, tmp_path: Path):
    found = check(SAMPLE, "--checkpoint", "default")["pose network"]
    told = found["values"]["ratio"]
    assert found["status"] == ("passed" if 0.8 <= told <= 1.25 else "warning")

    def stretch(message: Any) -> None:
        for link in message.transforms:
            link.transform.translation.x *= 3

    found = check(recordings.changed(sample, "/tf", stretch), "--checkpoint", "default")["pose network"]
    assert found["values"]["ratio"] == pytest.approx(told / 3, rel=0.15)
    assert found["status"] == "warning"
    assert "of the recorded way in 6 steps" in found["finding"]
    assert "finetune" in found["remedy"]


def test_cameras_without_a_common_view_are_a_warning_where_odometry_gives_the_scale(check, sample):
    others = [f"/camera/{name}/" for name in CAMERAS if name not in ("front", "back")]
    found = check(recordings.without(sample[: len(sample) // 2], *others))["overlaps"]
    assert found["status"] == "warning"
    assert "with recordings.motion: auto the scale comes from /tf" in found["remedy"]
