# SPDX-License-Identifier: Apache-2.0
"""The version of the installation that is running, for `--version` and beside every result."""

from xml.etree import ElementTree

from cvcdepth_ros.installation import share_directory


def package_version() -> str:
    """Return the version that package.xml states; ConfigError when the package's files are not installed."""
    return ElementTree.parse(share_directory() / "package.xml").findtext("version", default="unknown")
