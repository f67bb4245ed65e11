# SPDX-License-Identifier: Apache-2.0
"""What the demo writes, all in one folder."""

import shutil
from pathlib import Path


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

    def prepare(self) -> None:
        """Remove what an earlier run left, and nothing else; make the folders."""
        for folder in (self.recording, self.sheets, self.logs):
            shutil.rmtree(folder, ignore_errors=True)
        for file in (self.rig, self.parameters, self.result, self.page):
            file.unlink(missing_ok=True)
        for folder in (self.sheets, self.logs):
            folder.mkdir(parents=True)
