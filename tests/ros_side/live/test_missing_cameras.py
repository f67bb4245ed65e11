# SPDX-License-Identifier: Apache-2.0
"""`bag_replay run` on a recording in which a camera dies and another one's images are damaged."""

import json
from pathlib import Path
from typing import Any

import pytest
import recordings
from recordings import CAMERAS

from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording

SMALL = ("--untrained", "--height", "64", "--width", "96", "--clouds", "merged")


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Camera left falls silent after its third image; the fifth image of camera back is cut."""
    path = tmp_path_factory.mktemp("damaged") / "drive"
    kept, counts = [], dict.fromkeys(CAMERAS, 0)
    for entry in recordings.sample_entries():
        camera = entry.topic.split("/")[2] if entry.topic.endswith("image_raw/compressed") else ""
        counts |= {camera: counts.get(camera, 0) + 1}
        if camera == "left" and counts["left"] > 3:
            continue
        if camera == "back" and counts["back"] == 5:
            entry = entry._replace(cdr=without_end(entry.cdr))
        kept.append(entry)
    recordings.write_rosbag2(path, kept)
    return path


def without_end(cdr: bytes) -> bytes:
    """Overwrite the JPEG's end marker and what is before it."""
    end = cdr.rindex(b"\xff\xd9")
    return cdr[: end - 100] + bytes(102) + cdr[end + 2 :]


def published(path: Path) -> list[tuple[Any, list[str]]]:
    """The merged cloud's description of every set: stamp and cameras."""
    with open_recording(path) as recording:
        texts = [recording.deserialize(m).data for m in recording.messages(["/surround_depth/points/cameras"])]
    return [(text["stamp"], text["cameras"]) for text in map(json.loads, texts)]


def run(recording: Path, output: Path, *options: str) -> dict[str, Any]:
    assert main(["run", str(recording), "-o", str(output), *SMALL, *options]) == 0
    result: dict[str, Any] = json.loads((output / "run.json").read_text())
    return result


def test_without_min_cameras_only_whole_sets_are_computed(damaged: Path, tmp_path: Path):
    assert run(damaged, tmp_path / "depth")["sets"]["written"] == 3
    assert [cameras for _, cameras in published(tmp_path / "depth")] == [list(CAMERAS)] * 3


def test_with_min_cameras_every_set_has_the_cameras_that_are_there(damaged: Path, tmp_path: Path):
    result = run(damaged, tmp_path / "depth", "--min-cameras", "4", "--trace", str(tmp_path / "trace.json"))
    assert result["sets"]["written"] == 10
    contained = [cameras for _, cameras in published(tmp_path / "depth")]
    without_left = [name for name in CAMERAS if name != "left"]
    without_both = [name for name in without_left if name != "back"]
    assert contained == [list(CAMERAS)] * 3 + [without_left] + [without_both] + [without_left] * 5
    with open_recording(tmp_path / "depth") as recording:
        counts = {name: recording.topics[f"/surround_depth/{name}/depth/image_rect"].count for name in CAMERAS}
    assert counts == dict.fromkeys(CAMERAS, 10) | {"left": 3, "back": 9}
    names = {event["name"] for event in json.loads((tmp_path / "trace.json").read_text())}
    assert {"decode", "preprocess", "inference", "write"} <= names


def test_more_cameras_than_there_are_cannot_be_asked_for(damaged: Path, tmp_path: Path, capsys):
    assert main(["run", str(damaged), "-o", str(tmp_path / "depth"), *SMALL, "--min-cameras", "7"]) == 1
    assert "min_cameras: expected a whole number from 0 to 6" in capsys.readouterr().err
