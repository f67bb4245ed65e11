# SPDX-License-Identifier: Apache-2.0
"""Say in one line what this machine lacks for `make demo` and `make test`; runs under any Python 3.6 or newer."""

import importlib.util
import os
import platform
import sys


def missing() -> str:
    """Name the first thing that is missing and its remedy, or nothing."""
    python = f"{sys.executable} ({platform.python_version()})"
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        return f"Python 3.10 to 3.13 is needed, not {python}: name another, as in `make PYTHON=python3.12 demo`"
    if importlib.util.find_spec("ensurepip") is None:
        return f"{python} cannot make virtual environments: `apt install python3-venv` (Debian, Ubuntu)"
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        return f"the ROS 2 wheels are for x86_64 Linux, not {platform.platform()}: use a ROS 2 installation and colcon"
    libc, _, version = (os.confstr("CS_GNU_LIBC_VERSION") or "an unknown libc").rpartition(" ")
    if libc != "glibc" or tuple(map(int, version.split("."))) < (2, 28):
        return f"the ROS 2 wheels need glibc 2.28 or newer, not {libc} {version}"
    return ""


if __name__ == "__main__":
    sys.exit(missing() or 0)
