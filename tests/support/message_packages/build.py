# SPDX-License-Identifier: Apache-2.0
"""Build message packages that have no wheel into the environment of the Python that runs this: `python build.py STAMP`.

The ROS 2 wheels have the generators, but not the packages beside this file. Without a compiler nothing is built, no
stamp is left, and the tests that need them skip themselves.
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


def cmake(package: str, *arguments: str) -> None:
    """Run this environment's CMake; its output is shown only if it fails."""
    environment = os.environ | {
        "PATH": f"{PREFIX / 'bin'}:{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(PREFIX),
        "CMAKE_PREFIX_PATH": str(PREFIX),
    }
    done = subprocess.run(["cmake", *arguments], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\n{package}: cmake {' '.join(arguments)} failed")


def build(package: Path) -> None:
    """Configure, build and install one package."""
    with tempfile.TemporaryDirectory() as folder:
        python = f"-DPython3_EXECUTABLE={sys.executable}"
        places = ("-S", str(package), "-B", folder, f"-DCMAKE_INSTALL_PREFIX={PREFIX}")
        cmake(package.name, "-G", "Ninja", *places, python)
        cmake(package.name, "--build", folder, "--target", "install")
    print(f"{package.name}: built into {PREFIX}")


def main() -> None:
    """Build all packages, unless something is missing."""
    if missing := what_is_missing():
        print(f"message packages: not built, this machine has no {missing}: the tests that need them will be SKIPPED")
        return
    point_wheels_to_this_python()
    for description in sorted(Path(__file__).parent.glob("*/package.xml")):
        build(description.parent)
    Path(sys.argv[1]).touch()


if __name__ == "__main__":
    main()
