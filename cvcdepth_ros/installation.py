# SPDX-License-Identifier: Apache-2.0
"""The installation that is running: its version, and where its configuration, rigs and launch files lie."""

from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

from cvcdepth_core.errors import ConfigError

PACKAGE = "cvcdepth_ros"


def package_version() -> str:
    """Return the version that package.xml states; ConfigError when the package's files are not installed."""
    return ElementTree.parse(share_directory() / "package.xml").findtext("version", default="unknown")


def require_ros(what: str) -> None:
    """Raise ConfigError, with the remedy, where rclpy is not installed; `what` needs it."""
    try:
        is_installed = find_spec("rclpy") is not None
    except ValueError:  # somebody has put None into sys.modules
        is_installed = False
    if not is_installed:
        raise ConfigError(
            f"{what} needs ROS 2, but rclpy is not installed here: source a ROS 2 installation, or "
            "`pip install 'cvcdepth_ros[ros-jazzy]'`"
        )


def share_directory() -> Path:
    """Return the folder that holds `config/` and `launch/` of the very installation that is running.

    It is looked for upwards from this file, so that no environment variable can lead to another version's files: the
    source tree (an editable installation) holds `package.xml` and `config`; colcon and pip put them into
    `share/cvcdepth_ros` of the prefix that the code is installed in.

    Raises:
        ConfigError: neither is there; the message names the folders that were tried.

    """
    above = Path(__file__).absolute().parents[1:]
    candidates = [folder for parent in above for folder in (parent, parent / "share" / PACKAGE)]
    for folder in candidates:
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    tried = ", ".join(str(folder) for folder in candidates)
    raise ConfigError(f"the files of {PACKAGE} are not installed: no folder with package.xml and config among {tried}")
