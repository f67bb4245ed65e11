# SPDX-License-Identifier: Apache-2.0
"""Build tf2_msgs into the environment of the Python that runs this, and leave a stamp: `python build.py STAMP`.

The ROS 2 wheels have the generators, but not tf2_msgs. Without a compiler nothing is built, no stamp is left, and the
tests that need it skip themselves.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy as np

PREFIX = Path(sys.prefix)


def what_is_missing() -> str:
    """Name what a C++ build of a Python extension needs and this machine lacks, or nothing."""
    if shutil.which("c++") is None:
        return "C++ compiler (g++)"
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        return "Python.h (python3-dev)"
    return ""


def point_wheels_to_this_python() -> None:
    """Replace the include folders of the machine that built the wheels, in the CMake files that they export."""
    folders = {
        r"/opt/python/[^;\"]*/numpy/_core/include": np.get_include(),
        r"/opt/python/[^;\"/]*/include/python[0-9.]+": sysconfig.get_path("include"),
    }
    for exported in PREFIX.glob("share/*/cmake/*.cmake"):
        text = original = exported.read_text(encoding="utf-8")
        for theirs, ours in folders.items():
            text = re.sub(theirs, ours, text)
        if text != original:
            exported.write_text(text, encoding="utf-8")


def cmake(*arguments: str) -> None:
    """Run this environment's CMake; its output is shown only if it fails."""
    environment = os.environ | {
        "PATH": f"{PREFIX / 'bin'}:{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(PREFIX),
        "CMAKE_PREFIX_PATH": str(PREFIX),
    }
    done = subprocess.run(["cmake", *arguments], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\ntf2_msgs: cmake {' '.join(arguments)} failed")


def main() -> None:
    """Configure, build and install, unless something is missing."""
    if missing := what_is_missing():
        print(f"tf2_msgs: not built, this machine has no {missing}: the tests of /tf_static will be SKIPPED")
        return
    point_wheels_to_this_python()
    with tempfile.TemporaryDirectory() as build:
        source, python = str(Path(__file__).parent), f"-DPython3_EXECUTABLE={sys.executable}"
        cmake("-G", "Ninja", "-S", source, "-B", build, f"-DCMAKE_INSTALL_PREFIX={PREFIX}", python)
        cmake("--build", build, "--target", "install")
    Path(sys.argv[1]).touch()
    print(f"tf2_msgs: built into {PREFIX}")


if __name__ == "__main__":
    main()
