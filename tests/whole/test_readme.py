# SPDX-License-Identifier: Apache-2.0
"""Every command that the README shows works, as far as it can be run here.

`cvcdepth` commands are run as they stand. `make` targets and ROS 2's programs are looked up; test_packaging.py runs
what `pip install .` and `colcon build` put into place.
"""

import re
import shlex

import pytest
from repository import ROOT

from cvcdepth_ros.bag_replay import main

README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [
    line.split("  #")[0].strip()
    for block in re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    for line in block.splitlines()
    if line.strip()
]
RUN_ELSEWHERE = ("python3 -m venv", "pip install .", "colcon build", ". install/setup.bash")


def test_the_readme_is_short_and_opens_with_a_picture_that_is_there():
    assert len(README.splitlines()) <= 120
    first = re.match(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert first is not None
    assert (ROOT / first[1]).is_file()


def test_every_link_to_a_file_leads_somewhere():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("http")]
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_cvcdepth_commands_run_in_the_order_in_which_they_stand(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    commands = [command for command in COMMANDS if command.startswith("cvcdepth ") and "drives/" not in command]
    assert {shlex.split(command)[1] for command in commands} == {"inspect", "check", "rig", "run", "evaluate", "play"}
    for command in commands:
        if " play " in command:
            continue  # it needs ROS: test_bag_play.py runs it
        assert main(shlex.split(command)[1:]) == 0, f"{command}\n{capsys.readouterr().err}"


@pytest.mark.parametrize("command", [command for command in COMMANDS if "drives/" in command])
def test_commands_for_the_users_own_drives_have_only_options_that_there_are(command, capsys):
    """test_bag_finetune.py runs them, on the sample and at a small size."""
    _, subcommand, *words = shlex.split(command)
    with pytest.raises(SystemExit):
        main([subcommand, "--help"])
    known = set(re.findall(r"--?[a-z-]+", capsys.readouterr().out))
    assert {word for word in words if word.startswith("-")} <= known
    assert all((ROOT / word).is_file() for word in words if word.startswith("config/"))


@pytest.mark.parametrize("command", [command for command in COMMANDS if not command.startswith("cvcdepth ")])
def test_other_commands_name_what_exists(command):
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[:2] == ["ros2", "run"]:
        assert words[2] == "cvcdepth_ros"
        assert f'"{words[3]} = cvcdepth_ros.' in (ROOT / "setup.py").read_text()
    elif words[:2] == ["ros2", "launch"]:
        launch_file = (ROOT / "launch" / words[3]).read_text()
        given = {word.split(":=")[0] for word in words[4:]}
        assert given <= set(re.findall(r'DeclareLaunchArgument\("(\w+)"', launch_file))
    elif words[:2] == ["ros2", "param"]:
        assert words[2:5] == ["set", "/surround_depth", "checkpoint"]
        assert f"    {words[4]}:" in (ROOT / "config" / "surround_depth.yaml").read_text()
    else:
        assert command.startswith(RUN_ELSEWHERE), f"no test runs or checks: {command}"
