# SPDX-License-Identifier: Apache-2.0
"""The package as colcon and pip install it, and the lists that have to agree with each other."""

import os
import shutil
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree as ElementTree
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[1]
NOT_PACKAGED = shutil.ignore_patterns(
    ".*", "build", "install", "log", "output", "samples", "tests", "*.egg-info", "__pycache__"
)
PROGRAMS = {"surround_depth_node", "bag_replay", "cvcdepth"}
PRINT_SHARE = "from cvcdepth_ros.share import share_directory; print(share_directory())"
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()


def run(*command: object, **options: object) -> str:
    """Run a command that must succeed, without the paths of a ROS workspace that is sourced; return what it printed."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "AMENT_PREFIX_PATH")}
    arguments = [str(word) for word in command]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, f"{arguments}\n{done.stdout}{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("src") / "cvcdepth_ros", ignore=NOT_PACKAGED)


@pytest.fixture(scope="module")
def wheel(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, sources)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode())


@pytest.fixture(scope="module")
def pip_environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with the wheel, which borrows the other packages of this one and so downloads nothing."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    run(sys.executable, "-m", "pip", "--python", folder, "install", "-q", "--no-deps", wheel)
    (site_packages,) = folder.glob("lib/python*/site-packages")
    (site_packages / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
    return folder


@pytest.fixture(scope="module", params=["", "--symlink-install"], ids=["copied", "linked"])
def workspace(sources: Path, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("colcon_core", reason="no colcon in this environment")
    folder = tmp_path_factory.mktemp("workspace")
    (folder / "src").symlink_to(sources.parent)
    run(Path(sys.prefix, "bin/colcon"), "build", *request.param.split(), cwd=folder)
    return folder


def in_workspace(workspace: Path, command: str) -> str:
    """Run a shell command as a user does who has sourced the workspace, in this environment."""
    path = f"export PATH={sys.prefix}/bin:$PATH"
    return run("bash", "-c", f"{path}; . install/setup.bash; {command}", cwd=workspace)


def test_pip_gives_the_programs(pip_environment: Path):
    assert {program.name for program in (pip_environment / "bin").iterdir()} >= PROGRAMS
    assert "usage: cvcdepth" in run(pip_environment / "bin/cvcdepth", "--help")


def test_files_are_found_after_pip_install(pip_environment: Path):
    share = Path(run(pip_environment / "bin/python", "-c", PRINT_SHARE, cwd=pip_environment).strip())
    assert share == pip_environment / "share/cvcdepth_ros"
    assert_same_files(share)


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


def assert_same_files(share: Path) -> None:
    shipped = [path.relative_to(ROOT) for folder in ("config", "launch") for path in (ROOT / folder).rglob("*.*")]
    wanted = [path for path in shipped if "__pycache__" not in path.parts]
    assert wanted
    assert not [path for path in wanted if (share / path).read_bytes() != (ROOT / path).read_bytes()]


def test_versions_agree(metadata: Message):
    assert metadata["Version"] == MANIFEST.findtext("version")


def test_ros_packages_are_never_installed_unasked(metadata: Message):
    unasked = [line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert not [line for line in unasked if line.startswith(("ros-", "rclpy"))]
    assert any(line.startswith("torch") for line in unasked)


@pytest.mark.parametrize("name", ["demo", "core_test"])
def test_a_smaller_lock_pins_what_the_dev_lock_pins(name: str):
    assert pins(name) <= pins("dev")


def pins(name: str) -> set[str]:
    lines = (ROOT / "requirements" / f"{name}.lock").read_text(encoding="utf-8").splitlines()
    return {line for line in lines if not line.startswith("#")}
