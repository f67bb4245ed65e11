# SPDX-License-Identifier: Apache-2.0
"""The bag tool on drives that are odd in one way: they are used, and what is odd is told once."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recordings
import small_rig
from small_rig import BEGIN, IMAGE, raw

from cvcdepth_ros.bag_replay import main

SMALL = ("--untrained", "--height", "64", "--width", "96", "--quiet")


def json_of(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


@pytest.fixture
def early(tmp_path: Path) -> Path:
    """The transforms were recorded at time 0, before the first /clock."""
    first, *others = small_rig.entries(frames=6)
    return recordings.write_mcap(tmp_path / "early.mcap", [first._replace(log_time=0), *others])


def test_a_duration_counts_from_when_the_clock_was_set(early: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["run", str(early), "-o", str(tmp_path / "out"), "--duration", "0.35", *SMALL, "--json"]) == 0
    result = json_of(capsys)
    assert result["sets"]["written"] == 4
    assert any("before the clock was set, in 1970: /tf_static (1)" in note for note in result["notes"])


@pytest.mark.parametrize("command", ["inspect", "check", "rig"])
def test_an_unset_clock_is_told(command: str, early: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = ["-o", str(tmp_path / "rig.yaml")] if command == "rig" else []
    main([command, str(early), *output])
    printed = capsys.readouterr()
    assert "before the clock was set, in 1970" in " ".join((printed.out + printed.err).split())


def test_inspect_counts_from_the_clock_on_but_shows_all_messages(early: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["inspect", str(early), "--json"]) == 0
    (summary,) = json_of(capsys)["recordings"]
    assert (summary["start"], summary["seconds"]) == (BEGIN, 0.5)
    assert sum(topic["timing"]["messages"] for topic in summary["topics"]) == len(small_rig.entries(frames=6))
    assert summary["index"] == "intact"


def unset(message: Any) -> None:
    message.r = np.zeros(9)


@pytest.mark.parametrize("command", ["inspect", "check", "rig", "run"])
def test_how_a_camera_info_was_understood_is_told(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    drive = small_rig.write_drive(tmp_path, small_rig.entries(change=unset))
    more = {"rig": ["-o", str(tmp_path / "rig.yaml")], "run": ["-o", str(tmp_path / "out"), *SMALL]}
    main([command, str(drive), *more.get(command, [])])
    printed = capsys.readouterr()
    told = " ".join((printed.out + printed.err).split())
    assert "camera port: camera_info: R is all zeros, which means not set" in told


@pytest.mark.parametrize("command", ["inspect", "check", "rig"])
def test_which_image_was_taken_is_told(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    more = small_rig.more_images("/{}/image_rect_color", raw, IMAGE)
    drive = small_rig.write_drive(tmp_path, small_rig.in_time(small_rig.entries(), more))
    main([command, str(drive), *(["-o", str(tmp_path / "rig.yaml")] if command == "rig" else [])])
    printed = capsys.readouterr()
    told = " ".join((printed.out + printed.err).split())
    assert "/ahead/image_rect_color is taken (rectified, in colour, raw), not /ahead/image_raw/compressed" in told


def test_pictures_of_twelve_bits_are_not_black(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def deep(time: int, frame: str, bgr: np.ndarray) -> Any:
        return raw(time, frame, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype(np.uint16) << 4, "mono16")

    drive = small_rig.write_drive(tmp_path, small_rig.entries("/{}/image_raw", IMAGE, deep))
    main(["check", str(drive), "--skip", "places", "--json"])
    (recording,) = json_of(capsys)["recordings"]
    statuses = {check["name"]: check["status"] for check in recording["checks"]}
    assert (statuses["encodings"], statuses["brightness"]) == ("passed", "passed")


def test_a_camera_info_of_another_name_is_offered_by_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    drive = small_rig.write_drive(tmp_path, small_rig.entries(info_topic="/{}/calib_info"))
    assert main(["check", str(drive)]) == 1
    told = " ".join(capsys.readouterr().out.split())
    assert "did you mean /ahead/calib_info, /port/calib_info, /starboard/calib_info?" in told


def test_a_change_of_calibration_is_a_warning_of_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    drive = small_rig.entries(frames=6)
    other = small_rig.entries(
        frames=6, change=lambda message: setattr(message, "k", message.k * [1.2, 1, 1, 1, 1.2, 1, 1, 1, 1])
    )
    late = BEGIN + 3 * 10**8
    changed = [
        b if a.topic == "/port/camera_info" and a.log_time >= late else a for a, b in zip(drive, other, strict=True)
    ]
    main(["check", str(small_rig.write_drive(tmp_path, changed)), "--json"])
    (recording,) = json_of(capsys)["recordings"]
    (found,) = [check for check in recording["checks"] if check["name"] == "camera_info"]
    assert found["status"] == "warning"
    assert "camera port: its calibration changes" in found["finding"]
    assert "0.300 s after the beginning" in found["finding"]
