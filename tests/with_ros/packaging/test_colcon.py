# SPDX-License-Identifier: Apache-2.0
"""The package as colcon builds it."""

import sys
from pathlib import Path

import pytest
from packages import PRINT_SHARE, PROGRAMS, assert_same_files, copy_sources, run

pytest.importorskip("colcon_core", reason="no colcon in this environment")


@pytest.fixture(scope="module", params=["", "--symlink-install"], ids=["copied", "linked"])
def workspace(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("workspace")
    copy_sources(folder / "src" / "cvcdepth_ros")
    run(Path(sys.prefix, "bin/colcon"), "build", *request.param.split(), cwd=folder)
    return folder


def in_workspace(workspace: Path, command: str) -> str:
    """Run a shell command as a user does who has sourced the workspace, in this environment."""
    path = f"export PATH={sys.prefix}/bin:$PATH"
    return run("bash", "-c", f"{path}; . install/setup.bash; {command}", cwd=workspace)


def test_colcon_gives_the_programs(workspace: Path):
    programs = workspace / "install/cvcdepth_ros/lib/cvcdepth_ros"
    assert {program.name for program in programs.iterdir()} == PROGRAMS
    assert "usage: bag_replay" in in_workspace(workspace, f"{programs}/bag_replay --help")


@pytest.mark.parametrize("workspace", [""], indirect=True)
def test_a_built_program_runs_in_the_environment_that_is_active(workspace: Path):
    program = workspace / "install/cvcdepth_ros/lib/cvcdepth_ros/surround_depth_node"
    assert program.read_text().startswith("#!/usr/bin/env python3\n")


def test_files_are_found_after_colcon_build(workspace: Path):
    share = Path(in_workspace(workspace, f"python -c '{PRINT_SHARE}'").strip())
    assert share.is_relative_to(workspace.resolve())
    assert_same_files(workspace / "install/cvcdepth_ros/share/cvcdepth_ros")
    assert_same_files(share)
