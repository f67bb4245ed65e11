# SPDX-License-Identifier: Apache-2.0
"""The package's sources as a checkout has them, and what an installation must hold."""

import os
import shutil
import subprocess
from pathlib import Path

from repository import ROOT

PROGRAMS = {"surround_depth_node", "bag_replay", "cvcdepth"}
PRINT_SHARE = "from cvcdepth_ros.installation import share_directory; print(share_directory())"

_NOT_PACKAGED = shutil.ignore_patterns(
    ".*", "build", "install", "log", "output", "samples", "tests", "*.egg-info", "__pycache__"
)


def run(*command: object, **options: object) -> str:
    """Run a command that must succeed, without the paths of a ROS workspace that is sourced; return what it printed."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "AMENT_PREFIX_PATH")}
    arguments = [str(word) for word in command]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, f"{arguments}\n{done.stdout}{done.stderr}"
    return done.stdout


def copy_sources(path: Path) -> Path:
    return shutil.copytree(ROOT, path, ignore=_NOT_PACKAGED)


def assert_same_files(share: Path) -> None:
    shipped = [path.relative_to(ROOT) for folder in ("config", "launch") for path in (ROOT / folder).rglob("*.*")]
    wanted = [path for path in shipped if "__pycache__" not in path.parts]
    assert wanted
    assert not [path for path in wanted if (share / path).read_bytes() != (ROOT / path).read_bytes()]
