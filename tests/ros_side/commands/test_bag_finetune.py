# SPDX-License-Identifier: Apache-2.0
"""`finetune`: short runs on the shipped recording, what they leave behind, the gate, and what they refuse."""

import itertools
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import recordings
import yaml
from recordings import JAZZY, SAMPLE

from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.training.config import load_training_config
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.evaluation.trained_on import trained_parts

pytestmark = pytest.mark.timeout(600)  # whole runs, in a fixture too: minutes on a machine that does other work

SMALL = {
    "dataset": "recording",
    "depth": {
        "encoder": "efficientnet_lite0",
        "height": 64,
        "width": 96,
        "min_depth": 0.5,
        "max_depth": 80,
        "focal_scale": 48,
    },
    "pose": {"encoder": "efficientnet_lite0"},
    "recordings": {"held_out": 0.6, "min_travel": 0.1},  # six sets: with fewer there is no verdict
    "optimizer": {"epochs": 1, "samples_per_step": 2},
    "evaluation": {"max_depth": 80, "sets": 2},
}
CHEAP = ("--skip", "places", "--no-masks")  # what other tests are about
UNPROVEN = (*CHEAP, "--no-promotion")
PROMOTED, FINISHED, NOT_PROMOTED = 0, 0, 3


def write_config(path: Path, **changes: object) -> Path:
    path.write_text(yaml.safe_dump(SMALL | changes))
    return path


@pytest.fixture
def config(tmp_path):
    return lambda **changes: write_config(tmp_path / "finetune.yaml", **changes)


def command(config, run, *options: object, bags=(SAMPLE,)) -> list[str]:
    start = [] if "--from" in options else ["--from-scratch"]
    arguments = ["finetune", *bags, "--config", config, "-o", run, "--quiet", "--device", "cpu", *start, *options]
    return [str(argument) for argument in arguments]


def finetune(config, run, *options: object, bags=(SAMPLE,)) -> int:
    return main(command(config, run, *options, bags=bags))


class Run(NamedTuple):
    """A finished run."""

    folder: Path
    config: Path
    code: int

    @property
    def result(self) -> dict[str, Any]:
        return json.loads((self.folder / "finetune.json").read_text())

    @property
    def card(self) -> dict[str, Any]:
        return json.loads((self.folder / "model_card.json").read_text())

    @property
    def log(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def better(tmp_path_factory) -> Run:
    """A run that gets better: from random weights, on the whole sample."""
    folder = tmp_path_factory.mktemp("better")
    optimizer = {"epochs": 2, "samples_per_step": 5, "learning_rate": 2e-3}
    path = write_config(folder / "finetune.yaml", optimizer=optimizer, pictures_every=1)
    return Run(folder / "run", path, finetune(path, folder / "run"))


@pytest.fixture(scope="module")
def worse(better, tmp_path_factory) -> Run:
    """A run that spoils the weights of the other: its learning rate is absurd. Motion is recorded, but no LiDAR."""
    folder = tmp_path_factory.mktemp("worse")
    blind = recordings.write_rosbag2(folder / "blind <b>&", recordings.without(recordings.sample_entries(), "/lidar"))
    optimizer = {"epochs": 6, "samples_per_step": 5, "learning_rate": 0.5}
    recorded = SMALL["recordings"] | {"motion": "auto"}
    evaluation = SMALL["evaluation"] | {"patience": 2}
    path = write_config(folder / "finetune.yaml", optimizer=optimizer, evaluation=evaluation, recordings=recorded)
    start = better.folder / "best.safetensors"
    code = finetune(path, folder / "run", "--from", start, *CHEAP, bags=(blind,))
    return Run(folder / "run", path, code)


def test_weights_that_are_proven_better_on_the_held_out_part_are_promoted(better):
    assert better.code == PROMOTED
    result = better.result
    assert (result["promoted"], result["epochs"], result["steps"]) == (True, 2, 2)
    verdict = result["verdict"]
    assert (verdict["basis"], verdict["score"]) == ("LiDAR", "abs_rel")
    assert verdict["difference"]["high"] < 0
    before, after = (result["scores"][when]["held_out"]["abs_rel"] for when in ("before", "after"))
    assert after - before == pytest.approx(verdict["difference"]["difference"])
    assert (result["recordings"][0]["training_samples"], result["recordings"][0]["held_out_sets"]) == (2, 6)
    best = load_checkpoint(better.folder / "best.safetensors")
    assert result["sha256"] == best.sha256 == load_checkpoint(better.folder / "candidate.safetensors").sha256
    assert load_training_config(better.folder / "config.yaml") == load_training_config(better.config)


def test_the_scores_are_those_of_evaluate_on_the_held_out_part(better, tmp_path, capsys):
    with_start = json.loads((better.folder / "model_card.json").read_text())
    stamps = sorted(e.log_time for e in recordings.sample_entries() if e.topic.startswith("/camera/front/image"))
    start = (stamps[4] - min(e.log_time for e in recordings.sample_entries())) / 1e9 - 0.06
    arguments = ["evaluate", SAMPLE, "--checkpoint", better.folder / "best.safetensors", "--backend", "torch_eager"]
    window = ["--start", start, "--max-depth", 80, "--no-report", "--quiet", "--json", "-o", tmp_path]
    assert main([str(argument) for argument in (*arguments, *window)]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["sets"] == 6
    assert metrics["trained_on"] == []
    cameras = metrics["scores"]["image"]["metric"]["cameras"]
    expected = {name: numbers["all"]["abs_rel"] for name, numbers in cameras.items()}
    found = {name: numbers["abs_rel"] for name, numbers in with_start["scores"]["after"]["cameras"].items()}
    assert found.pop("back") == pytest.approx(expected.pop("back"), rel=1e-3)  # its roof is masked in the run
    assert found == pytest.approx(expected, rel=1e-6)


def test_weights_say_what_they_and_their_start_were_trained_on_and_not_what_was_held_out(better, worse):
    stamps = np.array(front_stamps(), dtype=np.int64)
    (part,) = trained_parts(load_checkpoint(better.folder / "best.safetensors"))
    assert (part.recording, part.sets_among(stamps), part.sets_among(stamps[4:])) == (SAMPLE.name, 4, 0)
    assert trained_parts(load_checkpoint(better.folder / "start.safetensors")) == []
    inherited, own = trained_parts(load_checkpoint(worse.folder / "last.safetensors"))
    assert inherited == part
    assert (own.recording, own.sets_among(stamps)) == ("blind <b>&", 4)


def front_stamps() -> list[int]:
    entries = [e for e in recordings.sample_entries() if e.topic.startswith("/camera/front/image")]
    headers = [JAZZY.deserialize_cdr(entry.cdr, entry.type).header.stamp for entry in entries]
    return [stamp.sec * 10**9 + stamp.nanosec for stamp in headers]


def test_recorded_motion_is_taken_told_and_taught(worse):
    assert worse.result["recordings"][0]["motion"] == "recorded (/tf)"
    assert all("recorded_motion" in entry["terms"] for entry in worse.log if "terms" in entry)
    scores = worse.card["scores"]
    for when in ("before", "after"):
        pose = scores[when]["pose_network"]
        assert pose["steps"] == 5
        assert pose["ratio"] == pytest.approx(pose["predicted_metres"] / pose["recorded_metres"])
        assert scores[when]["held_out"]["pose_ratio"] == pose["ratio"]
    text = (worse.folder / "model_card.md").read_text()
    assert "The pose network tells " in text
    assert "of the recorded way" in (worse.folder / "report.html").read_text()
    ratio = scores["before"]["pose_network"]["ratio"]
    told = [line for line in worse.result["warnings"] if line.startswith("the start's pose network tells")]
    assert bool(told) == (not 0.8 <= ratio <= 1.25)


def test_validations_are_logged_at_the_start_in_between_and_at_the_end(better):
    validations = [entry for entry in better.log if "validation" in entry]
    assert [entry["step"] for entry in validations] == [0, 1, 2]
    assert all(entry["validation"]["score"] == entry["validation"]["abs_rel"] for entry in validations)
    assert min(validations, key=lambda entry: entry["validation"]["score"])["step"] == int(
        better.card["weights"]["step"]
    )


def test_the_same_command_again_adds_nothing(better):
    kept = {path.name: path.read_bytes() for path in better.folder.glob("*.safetensors")}
    log = better.log
    assert finetune(better.config, better.folder) == PROMOTED
    assert {path.name: path.read_bytes() for path in better.folder.glob("*.safetensors")} == kept
    assert better.log == log


def test_what_was_promoted_stays_when_the_run_goes_on_to_weights_that_are_not(better, tmp_path):
    run = Run(shutil.copytree(better.folder, tmp_path / "run"), better.config, PROMOTED)
    shutil.copy(run.folder / "start.safetensors", run.folder / "candidate.safetensors")
    best = (run.folder / "best.safetensors").read_bytes()
    assert finetune(run.config, run.folder) == PROMOTED
    assert (run.folder / "best.safetensors").read_bytes() == best
    assert run.card["weights"] == better.card["weights"]
    assert run.card["scores"] == better.card["scores"]
    reason = run.result["verdict"]["reason"]
    assert "; these are weights of a former call, those of this one are not proven to be better than" in reason


def test_weights_of_a_run_whose_state_was_removed_are_not_taken_for_this_ones(config, tmp_path):
    best = tmp_path / "run" / "best.safetensors"
    best.parent.mkdir()
    best.write_bytes(b"learned from other recordings")
    one_step = config(optimizer={"epochs": 1, "samples_per_step": 9}, recordings={"held_out": 0, "min_travel": 0.1})
    assert finetune(one_step, tmp_path / "run", *UNPROVEN) == FINISHED
    assert not best.exists()


def test_weights_that_are_not_proven_better_are_not_promoted_and_the_exit_code_says_so(worse):
    assert worse.code == NOT_PROMOTED
    assert not (worse.folder / "best.safetensors").exists()
    assert not worse.result["promoted"]


def test_without_lidar_the_pictures_decide_and_it_is_said(worse):
    verdict = worse.result["verdict"]
    assert (verdict["basis"], verdict["score"]) == ("label-free", "photometric")
    assert "without LiDAR, by how well the depth explains the pictures" in verdict["reason"]
    assert verdict["difference"]["high"] >= 0
    assert worse.result["scores"]["after"]["cameras"]["front"]["abs_rel"] is None


def test_a_run_that_gets_no_better_ends_early(worse):
    assert worse.result["ended_early"]
    scores = [entry["validation"]["score"] for entry in worse.log if "validation" in entry]
    assert len(scores) == scores.index(min(scores)) + 3 == worse.result["epochs"] + 1 < 7


def test_the_card_tells_data_rigs_configuration_hashes_and_scores(better):
    card = better.card
    assert card["weights"] == {
        "file": "best.safetensors",
        "sha256": load_checkpoint(better.folder / "best.safetensors").sha256,
        "step": card["weights"]["step"],
    }
    (data,) = card["data"]
    assert data["recording"] == str(SAMPLE)
    assert ["samples/pandaset_002_excerpt" in name for name, *_ in data["files"]] == [True, True]
    assert data["from"].startswith("2019-05-11T")
    (rig,) = card["rigs"]
    assert [camera["name"] for camera in rig["cameras"]] == data["cameras"]
    assert card["configuration"] == load_training_config(better.config).model_dump(mode="json")
    assert len(card["configuration_sha256"]) == 64
    assert card["scores"]["before"]["cameras"].keys() == set(recordings.CAMERAS)
    text = (better.folder / "model_card.md").read_text()
    assert "**Promoted**: better than the start, by the LiDAR: Abs Rel" in text
    assert "| front\\_left | " in text


class Page(HTMLParser):
    """Headings, pictures and tags of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.pictures: list[str] = []
        self.text = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append(tag)
        if tag == "img":
            found = dict(attrs)
            assert found["src"].startswith("data:image/")
            self.pictures.append(found["alt"])

    def handle_data(self, data) -> None:
        self.text += data


def test_the_page_shows_verdict_scores_curves_and_depth_before_and_after(better):
    pytest.importorskip("matplotlib")
    page = Page(better.folder / "report.html")
    assert {"Loss and its terms", "Held-out scores"} < set(page.pictures)
    for title in ("Best set", "Worst set"):
        assert {f"{title}: before", f"{title}: after"} < set(page.pictures)
    assert "Fine-tuning: promoted" in page.text
    assert f"{better.card['verdict']['difference']['second']:.4f}" in page.text
    assert not {"script", "link", "iframe"} & set(page.tags)


def test_names_from_files_are_escaped_on_the_page_and_in_the_card(worse):
    pytest.importorskip("matplotlib")
    page = Page(worse.folder / "report.html")
    assert "blind <b>&" in page.text
    assert "b" not in page.tags
    assert "blind &lt;b&gt;&amp;" in (worse.folder / "model_card.md").read_text()


def test_tensorboard_has_the_numbers_and_the_pictures(better):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(better.folder / "tensorboard"))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("training/loss")]
    assert losses == [(e["step"], pytest.approx(e["loss"], rel=1e-6)) for e in better.log if "loss" in e]
    assert [event.step for event in events.Scalars("held_out/score")] == [0, 1, 2]
    pictures = {"input", "depth", "from_before", "from_neighbours", "error_temporal", "mask_temporal"}
    assert pictures | {"error_depth_consistency"} <= set(events.Tags()["images"])
    assert [event.step for event in events.Images("depth")] == [1, 2]
    shown = cv2.imdecode(np.frombuffer(events.Images("input")[0].encoded_image_string, np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (64, 6 * 96, 3)


def test_without_tensorboard_a_line_says_so_once(config, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    assert finetune(config(recordings={"min_travel": 9}), tmp_path / "run", *CHEAP) == 1
    assert capsys.readouterr().err.count("no TensorBoard files: tensorboard is not installed") == 1


def test_torchrun_trains_with_two_processes_as_one_does_with_their_samples(config, tmp_path):
    everything = {"held_out": 0.0, "min_travel": 0.1}
    short = recordings.write_rosbag2(tmp_path / "short", recordings.sample_entries(6))  # two steps of two samples
    path = config(optimizer=SMALL["optimizer"] | {"samples_per_batch": 2}, recordings=everything)
    assert finetune(path, tmp_path / "alone", *UNPROVEN, bags=(short,)) == FINISHED
    path = config(optimizer=SMALL["optimizer"], recordings=everything)
    torchrun = ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "cvcdepth_ros.bag_replay"]
    both = command(path, tmp_path / "both", "--json", *UNPROVEN, bags=(short,))
    program = [sys.executable, "-m", *torchrun, *both]
    finished = subprocess.run(program, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    result = json.loads(finished.stdout)
    logs = [Run(tmp_path / run, path, 0).log for run in ("alone", "both")]
    one, two = ([entry["loss"] for entry in log] for log in logs)
    assert len(one) == len(two) == result["steps"] == 2
    assert two[0] == pytest.approx(one[0], rel=1e-3)  # Adam makes of rounding whole steps; see test_distributed.py


def test_a_run_goes_on_from_the_weights_that_it_began_with_only(better, worse, capsys):
    assert finetune(better.config, better.folder, "--from", better.folder / "best.safetensors") == 1
    assert "its run started from random weights, now it is best.safetensors sha256:" in capsys.readouterr().err
    other = write_config(worse.folder.parent / "other.yaml", depth=SMALL["depth"] | {"max_depth": 200})
    assert finetune(other, worse.folder.parent / "other", "--from", better.folder / "best.safetensors", *CHEAP) == 1
    assert "max_depth is 80.0, but the configuration's depth.max_depth is 200.0" in capsys.readouterr().err


def test_a_run_goes_on_with_the_same_masks_only(better, capsys):
    assert finetune(better.config, better.folder, "--no-masks") == 1
    assert "state.pt: was made from something else: the masks of recording 1 was back " in capsys.readouterr().err


def test_a_run_that_holds_nothing_out_goes_on_with_the_same_recordings_and_start_only(config, better, tmp_path, capsys):
    path = config(optimizer={"epochs": 1, "samples_per_step": 5}, recordings={"held_out": 0, "min_travel": 0.1})
    short = recordings.write_rosbag2(tmp_path / "short", recordings.sample_entries(4))
    assert finetune(path, tmp_path / "run", *UNPROVEN, bags=(SAMPLE, short)) == FINISHED
    capsys.readouterr()
    assert finetune(path, tmp_path / "run", *UNPROVEN, bags=(short, SAMPLE)) == 1
    error = capsys.readouterr().err
    assert "recording 1 was pandaset_002_excerpt (" in error
    assert "recording 2 was short (" in error
    assert finetune(path, tmp_path / "run", *UNPROVEN) == 1
    error = capsys.readouterr().err
    assert "was made from something else: recording 2 was short (" in error
    assert "), now it is none; " in error
    start = better.folder / "candidate.safetensors"
    assert finetune(path, tmp_path / "run", "--from", start, *UNPROVEN, bags=(SAMPLE, short)) == 1
    assert "the start was random weights, now it is candidate.safetensors sha256:" in capsys.readouterr().err


def test_an_interrupted_run_keeps_its_last_checkpoint_and_says_how_to_go_on(config, tmp_path):
    path = config(optimizer={"epochs": 500, "samples_per_step": 5}, checkpoint_every=1, validate_every=400)
    program = [sys.executable, "-m", "cvcdepth_ros.bag_replay", *command(path, tmp_path / "run", *CHEAP)]
    log = tmp_path / "run" / "log.jsonl"
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: log.exists() and "loss" in log.read_text())
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "interrupted; the same command goes on from the last checkpoint" in err
    assert "Traceback" not in err
    assert load_checkpoint(tmp_path / "run" / "last.safetensors").spec.height == 64


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.1)


def refusal(entries, config, tmp_path, capsys, *options: object) -> str:
    """What the command says of a recording that it refuses; nothing is trained."""
    bag = recordings.write_rosbag2(tmp_path / "bag", entries)
    assert finetune(config(), tmp_path / "run", "--no-masks", *options, bags=(bag,)) == 1
    assert not (tmp_path / "run" / "last.safetensors").exists()
    return capsys.readouterr().err


def test_a_vehicle_that_stands_still_is_refused_before_the_first_step(config, tmp_path, capsys):
    def stand(message: Any) -> None:
        for link in message.transforms:
            link.transform.translation.x = link.transform.translation.y = link.transform.translation.z = 0.0

    error = refusal(recordings.changed(recordings.sample_entries(3), "/tf", stand), config, tmp_path, capsys)
    assert "bag: check 9, motion: 0.0 m in" in error
    assert "-> training needs a moving vehicle" in error


def test_too_little_motion_for_the_configuration_is_refused(config, tmp_path, capsys):
    assert finetune(config(recordings={"min_travel": 9}), tmp_path / "run", *CHEAP) == 1
    error = capsys.readouterr().err
    assert "pandaset_002_excerpt: no training sample" in error
    assert "min_travel is 9" in error


def test_samples_that_are_too_far_apart_are_told(config, tmp_path, capsys):
    entries = recordings.sample_entries()
    middle = (entries[0].log_time + entries[-1].log_time) / 2

    def jump(message: Any) -> None:
        for link in message.transforms:
            stamp = link.header.stamp
            link.transform.translation.x += 6.0 * (stamp.sec * 10**9 + stamp.nanosec > middle)

    fast = recordings.write_rosbag2(tmp_path / "fast", recordings.changed(entries, "/tf", jump))
    one_step = config(optimizer={"epochs": 1, "samples_per_step": 9}, recordings={"held_out": 0, "min_travel": 0.1})
    finetune(one_step, tmp_path / "run", *UNPROVEN, bags=(fast,))
    told = f"warning: {fast}: 2 training samples are left out: the vehicle moves up to 6."
    assert told in capsys.readouterr().err


def test_a_pose_that_cannot_be_used_is_told_and_the_recording_remains(config, tmp_path, capsys):
    numbers = itertools.count()

    def lose_direction(message: Any) -> None:
        if next(numbers) == 13:
            message.transforms[0].transform.rotation.w = 7.0

    entries = recordings.changed(recordings.sample_entries(), "/tf", lose_direction)
    bag = recordings.write_rosbag2(tmp_path / "bag", entries)
    assert finetune(config(recordings={"min_travel": 9}), tmp_path / "run", *CHEAP, bags=(bag,)) == 1
    error = capsys.readouterr().err
    assert f"warning: {bag}: 1 refused, the first: /tf: transform odom <- base_link: quaternion" in error
    assert "bag: no training sample in 10 sets" in error


def test_a_missing_camera_is_refused(config, tmp_path, capsys):
    entries = recordings.without(recordings.sample_entries(3), "/camera/left/image_raw/compressed")
    assert "bag: check 1, cameras: 5 found" in refusal(entries, config, tmp_path, capsys)


def test_the_vehicles_frame_is_the_one_that_is_named(config, tmp_path, capsys):
    assert finetune(config(), tmp_path / "run", "--base-frame", "chassis", *CHEAP) == 1
    assert "check 3, transforms: no frame is called chassis" in capsys.readouterr().err


def test_a_single_camera_learns_its_scale_from_odometry_and_is_refused_without(config, tmp_path, capsys):
    others = [f"/camera/{name}/" for name in recordings.CAMERAS if name != "front"]
    alone = recordings.without(recordings.sample_entries(), *others)
    bag = recordings.write_rosbag2(tmp_path / "alone", alone)
    assert finetune(config(), tmp_path / "refused", *CHEAP, bags=(bag,)) == 1
    error = capsys.readouterr().err
    assert "camera front: shares no view with another camera" in error
    assert "(recordings.motion: auto) the scale comes from the odometry" in error
    everything = config(recordings={"held_out": 0, "motion": "auto"}, optimizer={"epochs": 1, "samples_per_step": 8})
    assert finetune(everything, tmp_path / "run", *UNPROVEN, bags=(bag,)) == FINISHED
    (step,) = (entry for entry in Run(tmp_path / "run", everything, 0).log if "loss" in entry)
    assert step["terms"].keys() == {"temporal", "smoothness", "recorded_motion"}


def test_cameras_without_a_common_view_are_refused_without_odometry(config, tmp_path, capsys):
    gone = [f"/camera/{name}/" for name in recordings.CAMERAS if name not in ("front", "back")]
    entries = recordings.without(recordings.sample_entries(3), *gone)
    blind = [entry for entry in entries if entry.topic not in ("/tf", "/odom")]
    assert "check 6, overlaps: back, front shares no view with another camera" in refusal(
        blind, config, tmp_path, capsys
    )


def test_a_run_that_could_prove_nothing_is_refused_before_the_first_step(config, tmp_path, capsys):
    few = config(recordings={"held_out": 0.3})
    assert finetune(few, tmp_path / "run", *CHEAP) == 1
    assert not (tmp_path / "run" / "last.safetensors").exists()
    error = capsys.readouterr().err
    assert "promotion impossible: 3 held-out sets, 6 are needed" in error
    assert f"3 of {SAMPLE}; recordings.held_out is 0.3" in error
    assert "--no-promotion" in error


def test_swapped_cameras_are_refused_unless_the_check_is_left_out(config, tmp_path, capsys):
    def exchange(message: Any) -> None:
        links = {link.child_frame_id: link for link in message.transforms}
        left, right = (links[f"{name}_camera_optical_frame"] for name in ("left", "right"))
        left.transform, right.transform = right.transform, left.transform

    entries = list(recordings.changed(recordings.sample_entries(3), "/tf_static", exchange))
    error = refusal(entries, config, tmp_path, capsys)
    assert "check 12, places: left and right seem to be swapped" in error


def test_black_pictures_are_refused(config, tmp_path, capsys):
    def blacken(message: Any) -> None:
        message.data = cv2.imencode(".jpg", np.zeros((540, 960, 3), np.uint8))[1].ravel()

    entries = recordings.changed(recordings.sample_entries(3), "/camera/left/image_raw/compressed", blacken)
    error = refusal(entries, config, tmp_path, capsys, "--skip", "places")
    assert "check 11, brightness: black, or of one colour: pictures of left (3 of 3)" in error


def test_a_recording_that_cannot_be_used_is_left_out_by_name_beside_one_that_can(config, tmp_path, capsys):
    lame = recordings.write_rosbag2(
        tmp_path / "lame", recordings.without(recordings.sample_entries(2), "/camera/left/image_raw/compressed")
    )
    one_step = config(optimizer={"epochs": 1, "samples_per_step": 5}, recordings={"held_out": 0, "min_travel": 0.1})
    assert finetune(one_step, tmp_path / "run", *UNPROVEN, bags=(lame, SAMPLE)) == FINISHED
    caught = capsys.readouterr().err
    assert "warning: left out: " in caught
    assert "lame: check 1, cameras" in caught
    reason = json.loads((tmp_path / "run" / "finetune.json").read_text())["verdict"]["reason"]
    assert "nothing was proven: no recording has a held-out part" in reason


def test_what_a_recording_lost_is_told_and_not_counted_as_held_out(config, tmp_path, capsys):
    entries = recordings.sample_entries()
    left = [i for i, entry in enumerate(entries) if entry.topic == "/camera/left/image_raw/compressed"]
    for i in left[7:]:
        content = JAZZY.deserialize_cdr(entries[i].cdr, entries[i].type)
        content.data = content.data[:1000]
        entries[i] = entries[i]._replace(cdr=bytes(JAZZY.serialize_cdr(content, entries[i].type)))
    blind = recordings.write_rosbag2(tmp_path / "blind", entries)
    (blind / "blind_1.mcap").write_bytes(b"")
    third = {"held_out": 0.3, "min_travel": 0.1}
    one_step = config(optimizer={"epochs": 1, "samples_per_step": 9}, recordings=third)
    skipped = ("--skip", "brightness", *CHEAP)
    assert finetune(one_step, tmp_path / "run", *skipped, bags=(SAMPLE, blind)) in (PROMOTED, NOT_PROMOTED)
    lost = f"{blind}: not everything could be read: {blind}: metadata.yaml does not list blind_1.mcap, not read"
    assert f"warning: {lost}" in capsys.readouterr().err
    result = json.loads((tmp_path / "run" / "finetune.json").read_text())
    assert lost in result["warnings"]
    assert f"; not scored: {blind}: no set: 3 refused, the first: set at " in result["verdict"]["reason"]
    assert [entry["held_out_sets"] for entry in result["recordings"]] == [3, 0]


def test_a_lidar_that_is_named_and_not_there_is_told_before_the_first_step(config, tmp_path, capsys):
    assert finetune(config(), tmp_path / "run", *CHEAP, "--lidar", "/roof") == 1
    assert not (tmp_path / "run" / "last.safetensors").exists()
    assert "LiDAR /roof: no such topic; topics of sensor_msgs/msg/PointCloud2: /lidar/points" in capsys.readouterr().err


def test_without_lidar_on_demand_the_pictures_decide(config, tmp_path):
    one_step = config(optimizer={"epochs": 1, "samples_per_step": 5})
    run = Run(tmp_path / "run", one_step, finetune(one_step, tmp_path / "run", *CHEAP, "--no-lidar"))
    assert run.result["verdict"]["basis"] == "label-free"


def test_a_configuration_for_a_data_set_is_refused_at_once_in_one_line_with_the_remedy(config, tmp_path, capsys):
    path = config(dataset="ddad")
    nowhere = ("--from", tmp_path / "gone.safetensors", "--rig", tmp_path / "gone.yaml")
    assert finetune(path, tmp_path / "run", *nowhere, bags=(tmp_path / "gone.mcap",)) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"cvcdepth: {path}: dataset is 'ddad', for which there is no reader yet")
    assert line.endswith(f"write `dataset: recording` in this file, or in a new one below `base: {path}`")
    assert not (tmp_path / "run").exists()
