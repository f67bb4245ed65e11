# SPDX-License-Identifier: Apache-2.0
"""The files of a live run, all in one folder."""

import shutil
from pathlib import Path

from cvcdepth_core.errors import ConfigError


class DemoPaths:
    """The files and folders of one run."""

    def __init__(self, folder: Path) -> None:
        self.rig = folder / "rig.yaml"
        self.parameters = folder / "node.yaml"
        self.recording = folder / "recording"
        self.sheets = folder / "sets"
        self.logs = folder / "logs"
        self.result = folder / "demo.json"
        self.page = folder / "demo.html"

        self._mark = folder / ".cvcdepth_demo"

    def prepare(self) -> None:
        """Remove what an earlier run left, and make the folders.

        ConfigError when something else has one of the names: only what the demo wrote is removed.
        """
        folders, files = (self.recording, self.sheets, self.logs), (self.rig, self.parameters, self.result, self.page)
        found = [path for path in (*folders, *files) if path.exists()]
        if found and not self._mark.exists():
            raise ConfigError(
                f"{found[0]} was not written by the demo and will not be removed: choose another --output"
            )
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)
        for file in files:
            file.unlink(missing_ok=True)
        for folder in (self.sheets, self.logs):
            folder.mkdir(parents=True)
        self._mark.touch()
