# SPDX-License-Identifier: Apache-2.0
"""The bag tool as a program: help, exit codes, one line for what went wrong."""

import argparse
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import recordings
from recordings import SAMPLE, SAMPLE_MCAP
from repository import ROOT

from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_ros.bag_replay import COMMANDS, build_parser, main

PROGRAM = (sys.executable, "-m", "cvcdepth_ros.bag_replay")


def call(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """The real program in a process of its own."""
    return subprocess.run([*PROGRAM, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=60)


def refusal(*arguments: str | Path) -> str:
    """The one line, without traceback, that the program ends with when its job failed."""
    done = call(*arguments)
    assert done.returncode == 1, done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.startswith("warning: untrained")]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("cvcdepth: ")
    return lines[0]


def help_of(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_every_help_are_accepted(command: str, capsys: pytest.CaptureFixture[str]):
    examples = re.findall(rf"^  cvcdepth ({command} .+)$", help_of(capsys, command), re.MULTILINE)
    assert examples
    for example in examples:
        assert isinstance(build_parser("cvcdepth").parse_args(shlex.split(example)), argparse.Namespace)


def test_the_programs_help_lists_every_command(capsys: pytest.CaptureFixture[str]):
    text = help_of(capsys)
    for command in COMMANDS:
        assert re.search(rf"^    {command} +\S", text, re.MULTILINE)
        assert f"cvcdepth {command} --help" in text


def test_the_program_alone_shows_its_help(capsys: pytest.CaptureFixture[str]):
    assert main([]) == 0
    assert capsys.readouterr().out == help_of(capsys)


def test_every_command_that_makes_a_rig_takes_a_rig_file_and_the_vehicles_frame(capsys: pytest.CaptureFixture[str]):
    for command in ("check", "rig", "run", "evaluate", "finetune", "bench"):
        text = help_of(capsys, command)
        assert "--rig FILE" in text
        assert "--base-frame FRAME" in text


def test_help_and_version_load_neither_torch_nor_ros():
    script = "import sys, cvcdepth_ros.bag_replay; print({'torch', 'cv2', 'rclpy'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
    assert re.fullmatch(r"cvcdepth \d+\.\d+\.\d+\n", call("--version").stdout)


def started_as(name: str, folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """The program under the name that an installation gives it."""
    program = folder / name
    program.write_text("import sys\nfrom cvcdepth_ros.bag_replay import main\nsys.exit(main())\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    words = [sys.executable, program, *arguments]
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=60, env=environment)


@pytest.mark.parametrize("name", ["bag_replay", "cvcdepth"])
def test_usage_and_error_lines_have_the_name_that_was_typed_and_examples_the_one_name(name: str, tmp_path: Path):
    shown = started_as(name, tmp_path, "rig", "--help").stdout
    assert shown.startswith(f"usage: {name} rig ")
    assert "\n  cvcdepth rig drive.mcap\n" in shown
    assert started_as(name, tmp_path, "fly").stderr.splitlines()[-1].startswith(f"{name}: error: ")
    failed = started_as(name, tmp_path, "inspect", "gone.mcap")
    assert failed.stderr == f"{name}: gone.mcap: does not exist\n"


def test_what_the_program_says_calls_it_by_one_name():
    """Where a recording's remedies, a rig file's first line and the examples lead to is `cvcdepth`."""
    sources = [*(ROOT / "cvcdepth_core").rglob("*.py"), *(ROOT / "cvcdepth_ros").rglob("*.py")]
    pages = [ROOT / "README.md", *(ROOT / "config").rglob("*.*"), *(ROOT / "docs").glob("*.md")]
    called = {
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in (*sources, *pages)
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.search(rf"bag_replay`? ({'|'.join(COMMANDS)})\b", line) and "cvcdepth_ros.bag_replay " not in line
    }
    assert called == set()


@pytest.mark.parametrize(
    "arguments",
    [
        "fly drive.mcap",
        "--json",
        "rig",
        "run drive.mcap -o depth --width 640",
        "run drive.mcap -o depth --untrained --checkpoint w.safetensors",
        "run drive.mcap -o depth --untrained --tolerance -1",
        "run drive.mcap -o depth --untrained --height 65",
        "run drive.mcap -o depth --checkpoint w.safetensors --width 640",
        "run drive.mcap -o depth --untrained --depth-encoding 8UC1",
        "run drive.mcap -o depth --untrained --start soon",
        "export model.safetensors --precision float16",
        "export model.safetensors --tensorrt -o engine.plan",
        "play drive.mcap --rate 0",
        "play drive.mcap --duration -3",
    ],
)
def test_wrong_use_ends_with_2_and_says_what_is_wrong(arguments: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(shlex.split(arguments))
    assert ended.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_a_value_out_of_range_is_named_with_its_option(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(shlex.split("run drive.mcap -o depth --untrained --cloud-stride 0"))
    error = capsys.readouterr().err.splitlines()[-1]
    assert "--cloud-stride" in error
    assert "found 0" in error


@pytest.mark.parametrize("command", ["rig", "run"])
def test_a_recording_that_is_not_there_is_named(command: str, tmp_path: Path):
    options = {"run": ["-o", tmp_path / "depth", "--untrained"], "rig": ["-o", tmp_path / "rig.yaml"]}
    line = refusal(command, tmp_path / "gone.mcap", *options[command])
    assert "gone.mcap: does not exist" in line


def test_a_file_that_is_no_recording_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "notes.mcap"
    path.write_text("not a recording")
    assert main(["rig", str(path), "-o", str(tmp_path / "rig.yaml")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "notes.mcap: begins with" in line


def test_a_damaged_checkpoint_is_named(tmp_path: Path):
    checkpoint = small_checkpoint(tmp_path / "whole.safetensors")
    damaged = recordings.cut(checkpoint, tmp_path / "damaged.safetensors", 0.5)
    assert "damaged.safetensors: is damaged" in refusal(
        "run", SAMPLE, "-o", tmp_path / "depth", "--checkpoint", damaged
    )


def test_a_checkpoint_for_another_architecture_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    checkpoint = small_checkpoint(tmp_path / "other.safetensors", "resnet34")
    output = tmp_path / "depth"
    assert main(["run", str(SAMPLE), "-o", str(output), "--checkpoint", str(checkpoint)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "other.safetensors: depth network (resnet34): missing" in line
    assert not output.exists()


def small_checkpoint(path: Path, encoder: str = "resnet18") -> Path:
    """A resnet18's weights, called those of `encoder`."""
    spec = DepthModelSpec(encoder=encoder, height=64, width=96, min_depth=1.5, max_depth=200.0)
    save_checkpoint(path, spec, DepthNet("resnet18").state_dict())
    return path


def test_a_checkpoint_runs_and_its_hash_is_in_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    checkpoint = small_checkpoint(tmp_path / "model.safetensors")
    options = ("--checkpoint", str(checkpoint), "--duration", "0.15", "--json")
    assert main(["run", str(SAMPLE), "-o", str(tmp_path / "depth"), *options]) == 0
    digest = hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    assert json.loads(capsys.readouterr().out)["model"].startswith(f"model.safetensors sha256:{digest[:12]} with ")


def test_a_device_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = ("--untrained", "--device", "cuda:77")
    assert main(["run", str(SAMPLE_MCAP), "-o", str(tmp_path / "depth"), *options]) == 1
    assert "'cuda:77' is not available" in capsys.readouterr().err


def test_an_untrained_network_is_called_meaningless(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = ("--untrained", "--height", "64", "--width", "96", "--duration", "0.15")
    assert main(["run", str(SAMPLE), "-o", str(tmp_path / "depth"), *options]) == 0
    assert "random weights, and its depth means nothing" in capsys.readouterr().err


def test_playing_without_ros_is_refused_in_one_line():
    script = "import sys; sys.modules['rclpy'] = None; from cvcdepth_ros.bag_replay import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", script, "play", str(SAMPLE)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "rclpy cannot be imported" in line


def test_a_reader_that_closes_the_pipe_early_sees_no_traceback(tmp_path: Path):
    command = shlex.join([*PROGRAM, "rig", str(SAMPLE), "-o", str(tmp_path / "rig.yaml"), "--json"])
    done = subprocess.run(["sh", "-c", f"{command} | true"], capture_output=True, text=True, check=False)
    assert done.stderr == ""


def without(*modules: str) -> str:
    """The beginning of a script that finds none of these modules."""
    return f"import sys; sys.modules.update(dict.fromkeys({modules!r}))\n"


@pytest.mark.parametrize(
    ("call", "told"),
    [
        ("from cvcdepth_ros.bag_replay import main; sys.exit(main(['bench', *sys.argv[1:]]))", "cvcdepth: bench needs"),
        (
            "from cvcdepth_ros.demo.__main__ import main; sys.exit(main(['--recording', *sys.argv[1:]]))",
            "demo: the demo",
        ),
    ],
)
def test_what_drives_a_node_says_without_ros_what_is_missing_in_one_line(call: str, told: str):
    words = [sys.executable, "-c", without("rclpy") + call, str(SAMPLE), "--untrained", "--height", "64"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    *_, line = done.stderr.splitlines()
    assert line.startswith(told)
    assert "pip install 'cvcdepth_ros[ros-jazzy]'" in line


def test_the_nodes_help_is_there_without_ros_and_running_it_says_what_is_missing_in_one_line():
    script = without("rclpy") + "from cvcdepth_ros.surround_depth_node import main; main()"
    shown = subprocess.run([sys.executable, "-c", script, "--help"], capture_output=True, text=True, check=True)
    assert "usage: surround_depth_node" in shown.stdout
    assert "  min_cameras      Cameras without which no set is made" in shown.stdout
    refused = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    (line,) = refused.stderr.splitlines()
    assert "needs ROS 2, but" in line
    assert "extra ros-jazzy" in line
