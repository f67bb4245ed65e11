# SPDX-License-Identifier: Apache-2.0
"""`simulate` as a command: its recording goes through check, run and evaluate; what is wrong is named in one line."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
from repository import ROOT
from simple_worlds import short_drive, street_spec, two_cameras

from cvcdepth_core.rig.ground import heights_above_ground
from cvcdepth_core.rig.rig_file import save_rig_layout
from cvcdepth_core.worlds.shards import Shard
from cvcdepth_core.worlds.world_file import load_world, save_world
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.simulation.choices import KNOWN_RIGS, chosen_layout

EMBREE = pytest.importorskip("embreex", reason="worlds need embreex")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    save_rig_layout(folder / "rig.yaml", two_cameras())
    save_world(folder / "world.yaml", street_spec())
    return folder


@pytest.fixture(scope="module")
def drive(files: Path) -> Path:
    options = ["--rig", files / "rig.yaml", "--world", files / "world.yaml", "--seconds", "0.4", "--size", "96x64"]
    assert main(["simulate", *map(str, options), "-o", str(files / "drive"), "--workers", "1", "--quiet"]) == 0
    return files / "drive"


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["simulate", *map(str, arguments)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_check_finds_nothing_wrong_with_it(drive: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(drive), "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)["recordings"]
    status = {check["name"]: check["status"] for check in result["checks"]}
    assert "failed" not in status.values()
    assert status["LiDAR"] == status["motion"] == status["sets"] == "passed"


def test_run_and_evaluate_work_on_it_without_options(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["run", str(drive), "-o", str(tmp_path / "depth"), "--quiet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sets"]["written"] == 4
    assert main(["evaluate", str(drive), "-o", str(tmp_path / "scores"), "--quiet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["truth_points"] > 100


def test_its_world_can_be_edited_and_simulated_again(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    world = load_world(drive / "world.yaml")
    save_world(tmp_path / "bare.yaml", world.model_copy(update={"trees": (), "vehicles": ()}))
    files = ["--rig", drive / "rig.yaml", "--world", tmp_path / "bare.yaml", "-o", tmp_path / "again"]
    options = shlex.split("--seconds 0.1 --look clean --workers 1 --json --no-lidar --truth none")
    assert main(["simulate", *map(str, files), *options]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["sets"] == 1
    assert "saloon" not in result["objects"]
    assert not any("truth" in topic or "lidar" in topic for topic in result["messages"])


def test_many_drives_become_shards(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = shlex.split(
        "--rig random --world rural --many 2 --seconds 0.1 --size 48x32 --samples 1 --workers 1 --json"
    )
    assert main(["simulate", *options, "-o", str(tmp_path / "shards")]) == 0
    assert json.loads(capsys.readouterr().out)["drives"] == 2
    assert len({Shard(path).layout for path in (tmp_path / "shards").glob("*.shard.zip")}) == 2


@pytest.mark.parametrize("height", [None, 0.0, -0.4])
def test_a_rigs_cameras_are_as_high_above_the_worlds_ground_as_above_its_own(tmp_path: Path, height: float | None):
    given = two_cameras().model_copy(update={"ground_height": height})
    save_rig_layout(tmp_path / "rig.yaml", given)
    layout = chosen_layout(str(tmp_path / "rig.yaml"), (96, 64), 0)
    assert layout.ground_height == 0.0
    assert heights_above_ground(layout.complete()) == pytest.approx(heights_above_ground(given.complete()))


@pytest.mark.parametrize("name", KNOWN_RIGS)
def test_rigs_like_those_of_data_sets_are_complete(name: str):
    layout = chosen_layout(name, (96, 64), 0)
    assert len(layout.cameras) == 6
    assert all(camera.calibration.image_size == (96, 64) for camera in layout.complete().cameras)
    assert len(layout.complete().neighbours[layout.names[0]]) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--rig {config}/ddad.yaml", "ddad.yaml: camera camera_01: no calibration; a rig needs both to be simulated"),
        ("--rig gone.yaml", "rig file gone.yaml: cannot be read"),
        ("--world moon", "world moon: neither a file, nor a seed, nor a kind of place; kinds are city, suburb"),
        ("--world {files}/parts.yaml", "parts.yaml: statues: Extra inputs are not permitted"),
        ("--sensors {files}/sensors.yaml", "sensors.yaml: rate: Input should be greater than 0"),
        (
            "--rig {files}/rig.yaml --world {files}/walled.yaml",
            "the vehicle starts inside of something: building at x ",
        ),
        (
            "--rig {files}/folded.yaml --world {files}/world.yaml",
            "camera front: plumb_bob with d = .* cannot be inverted",
        ),
    ],
)
def test_what_is_wrong_is_named_in_one_line(
    arguments: str, message: str, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (files / "parts.yaml").write_text("statues: []\n")
    (files / "sensors.yaml").write_text("rate: 0\n")
    street = street_spec()
    save_world(
        files / "walled.yaml", street.model_copy(update={"drive": street.drive.model_copy(update={"at": (5.0, 9.0)})})
    )
    folded = two_cameras().cameras[0].calibration.model_copy(update={"d": (-0.9, 0.1, 0.0, 0.0, 0.0)})
    save_rig_layout(files / "folded.yaml", two_cameras(calibration=folded))
    given = arguments.format(config=ROOT / "config" / "rigs", files=files).split()
    line = refusal(capsys, *given, "-o", tmp_path / "drive", "--seconds", 0.1, "--workers", 1, "--quiet")
    assert re.search(message, line), line


def test_without_the_ray_engine_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "embreex", None)
    line = refusal(capsys, "-o", tmp_path / "drive")
    assert "pip install 'cvcdepth_ros[worlds]' brings embreex" in line


@pytest.mark.parametrize(
    "arguments",
    [
        "",
        "-o x --size 640",
        "-o x --size 5x5",
        "-o x --quality 0",
        "-o x --workers 0",
        "-o x --stagger 1",
        "-o x --look odd",
        "-o x --many 2 --images raw",
        "-o x --many 2 --no-lidar",
        "-o x --body varied",
    ],
)
def test_wrong_use_ends_with_2(arguments: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["simulate", *arguments.split()])
    assert ended.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_the_options_of_a_drive_are_beside_it(drive: Path):
    result = json.loads((drive / "simulation.json").read_text())
    assert result["configuration"]["seconds"] == 0.4
    assert result["configuration"]["sensors"]["rate"] == short_drive().sensors.rate
    assert result["objects"][:2] == ["sky", "own vehicle"]
