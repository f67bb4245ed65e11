# SPDX-License-Identifier: Apache-2.0
"""The package as pip installs it, and the lists that have to agree with each other."""

import sys
import sysconfig
import xml.etree.ElementTree as ElementTree
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest
from packages import PRINT_SHARE, PROGRAMS, ROOT, assert_same_files, copy_sources, run
from packaging.requirements import Requirement

MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    sources = copy_sources(folder / "cvcdepth_ros")
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


def test_pip_gives_the_programs(pip_environment: Path):
    assert {program.name for program in (pip_environment / "bin").iterdir()} >= PROGRAMS
    assert "usage: cvcdepth" in run(pip_environment / "bin/cvcdepth", "--help")


def test_files_are_found_after_pip_install(pip_environment: Path):
    share = Path(run(pip_environment / "bin/python", "-c", PRINT_SHARE, cwd=pip_environment).strip())
    assert share == pip_environment / "share/cvcdepth_ros"
    assert_same_files(share)


def test_versions_agree(metadata: Message):
    assert metadata["Version"] == MANIFEST.findtext("version")


def test_ros_packages_are_never_installed_unasked(metadata: Message):
    unasked = [line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert not [line for line in unasked if line.startswith(("ros-", "rclpy"))]
    assert any(line.startswith("torch") for line in unasked)


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
@pytest.mark.parametrize("name", ["demo", "core_test"])
def test_a_smaller_lock_pins_what_the_dev_lock_pins(name: str, python: str):
    assert pins(name, python) - pins("dev", python) == set()


@pytest.mark.parametrize("name", ["dev", "demo", "core_test"])
def test_a_lock_has_a_hash_for_whatever_it_pins(name: str):
    assert all(" --hash=sha256:" in requirement for requirement in requirements_of(name))


def pins(name: str, python: str) -> set[str]:
    """What the lock installs on Linux."""
    environment = {"python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux"}
    pinned = [Requirement(line.partition(" --hash")[0]) for line in requirements_of(name)]
    return {f"{p.name}{p.specifier}" for p in pinned if p.marker is None or p.marker.evaluate(environment)}


def requirements_of(name: str) -> list[str]:
    """The lock's requirements, one line each."""
    content = (ROOT / "requirements" / f"{name}.lock").read_text(encoding="utf-8").replace("\\\n", " ")
    return [" ".join(line.split()) for line in content.splitlines() if not line.startswith("#")]
