# SPDX-License-Identifier: Apache-2.0
"""Somebody's own rig by `docs/own_rig.md` alone: its commands, as they stand, on the recording that it describes."""

import re
import shlex
from pathlib import Path

import pytest
import yaml
from repository import ROOT

pytest.importorskip("embreex", reason="worlds need embreex")

from own_robot import YAWS, recorded_drive

from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.settings import NodeParameters

PAGE = (ROOT / "docs" / "own_rig.md").read_text(encoding="utf-8")
COMMANDS = [
    line.split("  #")[0].strip()
    for block in re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
]
NOT_PROMOTED = 3


def commands(program: str) -> list[list[str]]:
    return [words[1:] for words in map(shlex.split, COMMANDS) if words[0] == program]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the recording, and after the first test what the commands wrote."""
    folder = tmp_path_factory.mktemp("robot")
    recorded_drive(folder, 1.2)
    (configuration,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    # Of a second of driving a quarter would be too little to prove anything by.
    (folder / "robot_training.yaml").write_text(configuration.replace("held_out: 0.25", "held_out: 0.5"))
    return folder


def test_the_commands_lead_from_a_recording_to_a_trained_network(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(folder)
    words = commands("cvcdepth")
    assert [word[0] for word in words] == ["inspect", "check", "rig", "check", "run", "evaluate", "finetune"]
    codes = list(map(main, words))
    assert codes[:-1] == [0, 1, 0, 0, 0, 0], capsys.readouterr().err
    assert codes[-1] in (0, NOT_PROMOTED), capsys.readouterr().err
    told = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert (
        "a7, b2, c9, d4 shares no view with another camera -> show all of each lens (`cvcdepth rig BAG --view" in told
    )
    assert "4 of 114 degrees, shown whole" in told
    layout = load_rig_layout(folder / "robot_rig.yaml")
    assert (layout.base_frame, set(layout.names)) == ("chassis", set(YAWS))
    assert Path("trained", "candidate.safetensors").is_file()
    assert Path("trained", "model_card.md").is_file()


def test_without_a_base_frame_the_frames_and_the_option_are_named(folder: Path, capsys: pytest.CaptureFixture[str]):
    for command in ("rig", "run"):
        assert main([command, str(folder / "robot"), "-o", str(folder / f"no_{command}")]) == 1
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("cvcdepth: ")]
        assert "frame 'base_link' is unknown; known are ['chassis', 'eye_a7'" in line
        assert "--base-frame" in line


def test_the_node_has_the_parameters_that_the_page_gives_it():
    given = [word.partition(":=")[0] for words in commands("ros2") for word in words if ":=" in word]
    assert given
    assert set(given) <= NodeParameters.model_fields.keys()


def test_the_pages_configuration_is_the_shipped_one_but_for_size_and_length():
    (own,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    shipped = yaml.safe_load((ROOT / "config" / "training" / "finetune.yaml").read_text(encoding="utf-8"))
    own = yaml.safe_load(own)
    assert own["pose"] == shipped["pose"]
    assert own["recordings"] == shipped["recordings"]
