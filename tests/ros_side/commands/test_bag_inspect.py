# SPDX-License-Identifier: Apache-2.0
"""`bag_replay inspect`: what is in recordings, and how well they were recorded."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
from recordings import CAMERAS, SAMPLE, SAMPLE_MCAP, Entry

from cvcdepth_ros.bag_replay import main

FRONT = "/camera/front/image_raw/compressed"
LEFT = "/camera/left/image_raw/compressed"
MS = 1_000_000


@pytest.fixture(scope="module")
def sample() -> list[Entry]:
    return recordings.sample_entries()


def inspected(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    assert main(["inspect", str(path), "--json", *options]) == 0
    (summary,) = json.loads(capsys.readouterr().out)["recordings"]
    return summary


def timings(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {topic["name"]: topic["timing"] for topic in summary["topics"]}


def test_topics_rates_and_sizes_are_those_of_the_sample(sample: list[Entry], capsys: pytest.CaptureFixture[str]):
    summary = inspected(SAMPLE, capsys)
    topics = timings(summary)
    assert {name: timing["messages"] for name, timing in topics.items()} == {
        entry.topic: sum(other.topic == entry.topic for other in sample) for entry in sample
    }
    assert topics[FRONT]["bytes"] == sum(len(entry.cdr) for entry in sample if entry.topic == FRONT)
    assert topics[FRONT]["rate"] == pytest.approx(10, abs=0.05)
    assert topics[FRONT]["interval"] == pytest.approx(0.1, abs=0.001)
    assert topics[FRONT]["largest_gap"] == pytest.approx(0.1, abs=0.001)
    assert topics[FRONT]["gaps"] == topics[FRONT]["steps_back"] == topics[FRONT]["repeated"] == 0
    assert topics["/tf_static"]["rate"] is None
    assert summary["seconds"] == pytest.approx(1.0005, abs=0.001)
    assert summary["index"] == "intact"
    assert summary["files"][0] | {"bytes": 0} == {
        "path": str(SAMPLE_MCAP), "bytes": 0, "messages": 271, "index": "intact", "damage": [],
    }  # fmt: skip


def test_cameras_are_described_by_their_camera_info(sample: list[Entry], tmp_path: Path, capsys):
    def distort(message: Any) -> None:
        message.distortion_model, message.d = "equidistant", np.array([0.1, 0, 0, 0])

    def uncalibrate(message: Any) -> None:
        message.k = np.zeros(9)

    changed = recordings.changed(sample, "/camera/left/camera_info", distort)
    changed = recordings.changed(changed, "/camera/back/camera_info", uncalibrate)
    summary = inspected(recordings.write_rosbag2(tmp_path / "bag", changed), capsys)
    cameras = {camera["name"]: camera for camera in summary["cameras"]}
    assert set(cameras) == set(CAMERAS)
    assert cameras["front"]["frame_id"] == "front_camera_optical_frame"
    assert (cameras["front"]["calibration"]["width"], cameras["front"]["calibration"]["height"]) == (960, 540)
    assert cameras["left"]["calibration"]["distortion_model"] == "equidistant"
    assert cameras["back"]["calibration"] is None
    assert "K[0] = 0" in cameras["back"]["problem"]


def test_a_gap_is_counted_and_measured(sample: list[Entry], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = recordings.write_rosbag2(tmp_path / "bag", recordings.with_gap(sample, FRONT, 4, 6))
    front = timings(inspected(path, capsys))[FRONT]
    assert (front["messages"], front["gaps"]) == (7, 1)
    assert front["largest_gap"] == pytest.approx(0.4, abs=0.001)


def test_jitter_and_the_clocks_distance_are_measured_from_the_stamps(sample: list[Entry], tmp_path: Path, capsys):
    shaken = recordings.restamped(sample, FRONT, lambda number, stamp: stamp + (20 * MS if number % 2 else 0))
    late = recordings.restamped(shaken, LEFT, lambda _, stamp: stamp - 250 * MS)
    topics = timings(inspected(recordings.write_rosbag2(tmp_path / "bag", late), capsys))
    assert topics[FRONT]["jitter"] == pytest.approx(0.04, abs=0.002)  # 80 and 120 ms, and the median is one of them
    assert topics[LEFT]["clock_offset"] == pytest.approx({"median": 0.25, "lowest": 0.25, "highest": 0.25}, abs=0.001)


def test_steps_back_repeats_and_missing_stamps_are_told(sample: list[Entry], tmp_path: Path, capsys):
    swapped = recordings.restamped(sample, FRONT, lambda n, stamp: stamp + {4: 100 * MS, 5: -100 * MS}.get(n, 0))
    zero = recordings.restamped(swapped, LEFT, lambda *_: 0)
    topics = timings(inspected(recordings.write_rosbag2(tmp_path / "bag", zero), capsys))
    assert topics[FRONT]["steps_back"] == 1
    assert topics[LEFT]["stamped"] is False
    assert topics[LEFT]["clock_offset"] is None
    assert topics[LEFT]["rate"] == pytest.approx(10, abs=0.05), "by the log times"


def test_a_part_is_inspected_when_asked_for(capsys: pytest.CaptureFixture[str]):
    topics = timings(inspected(SAMPLE, capsys, "--start", "0.5", "--duration", "0.2"))
    assert topics[FRONT]["messages"] == 2


def test_the_state_of_the_index_is_told(sample: list[Entry], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    plain = recordings.write_mcap(tmp_path / "plain.mcap", sample, repeat_channels=False, use_statistics=False)
    assert inspected(plain, capsys)["index"] == "rebuilt"
    cut = inspected(recordings.cut(SAMPLE_MCAP, tmp_path / "cut.mcap"), capsys)
    assert cut["index"] == cut["files"][0]["index"] == "damaged"
    assert f"{cut['files'][0]['messages']} messages" in cut["damage"]
    assert cut["files"][0]["messages"] > 100


def test_a_damaged_chunk_shows_since_every_message_is_read(sample: list[Entry], tmp_path: Path, capsys):
    whole = recordings.write_mcap(tmp_path / "whole.mcap", sample)
    chunk = recordings.stored_chunks(whole)[3]
    flipped = recordings.flipped_byte(whole, tmp_path / "flipped.mcap", (chunk.start + chunk.end) // 2)
    assert main(["inspect", str(flipped)]) == 0
    assert f"chunk at byte {chunk.start} skipped" in capsys.readouterr().out


def test_the_text_tells_what_is_wrong_below_its_table(sample: list[Entry], tmp_path: Path, capsys):
    def uncalibrate(message: Any) -> None:
        message.k = np.zeros(9)

    swapped = recordings.restamped(sample, FRONT, lambda n, stamp: stamp + {4: 100 * MS, 5: -100 * MS}.get(n, 0))
    path = recordings.write_rosbag2(
        tmp_path / "bag", recordings.changed(swapped, "/camera/left/camera_info", uncalibrate)
    )
    assert main(["inspect", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"  {FRONT}: 1 of 10 stamps step back" in lines
    assert "  camera left: camera_info: K[0] = 0: the camera is not calibrated" in lines


def test_the_text_has_a_line_for_every_topic_and_camera(capsys: pytest.CaptureFixture[str]):
    assert main(["inspect", str(SAMPLE)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == str(SAMPLE)
    assert "271 messages" in lines[1]
    assert "index intact" in lines[1]
    assert [line.split()[0] for line in lines if line.startswith("/camera/front/")] == [
        "/camera/front/camera_info",
        FRONT,
    ]
    assert [line.split()[0] for line in lines[-6:]] == sorted(CAMERAS)
    assert max(map(len, lines)) <= 120


def test_what_cannot_be_read_is_named_and_does_not_stop_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recordings.lone_mcap(tmp_path / "good.mcap")
    (tmp_path / "bad.mcap").write_bytes(b"no recording at all")
    assert main(["inspect", str(tmp_path), "--json"]) == 1
    out, err = capsys.readouterr()
    assert [Path(summary["path"]).name for summary in json.loads(out)["recordings"]] == ["good.mcap"]
    (line,) = err.splitlines()
    assert "bad.mcap: begins with b'no recording" in line
