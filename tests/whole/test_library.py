# SPDX-License-Identifier: Apache-2.0
"""The example of library use on docs/library.md, as it stands there."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import CAMERAS, JAZZY, SAMPLE, sample_entries
from repository import ROOT

from cvcdepth_core.model_choices import checkpoint_path
from cvcdepth_ros.bag_replay import main

PAGE = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What the example calls `found`, in a folder with the files that it names."""
    monkeypatch.chdir(tmp_path)
    for entry in sample_entries(1):
        if entry.type == "sensor_msgs/msg/CompressedImage":
            message: Any = JAZZY.deserialize_cdr(entry.cdr, entry.type)
            Path(f"{entry.topic.split('/')[2]}.jpg").write_bytes(message.data.tobytes())
    assert main(["rig", str(SAMPLE), "-o", "rig.yaml"]) == 0
    Path("model.safetensors").symlink_to(checkpoint_path("default"))
    names: dict[str, Any] = {}
    exec(example(), names)
    return names["found"]


def example() -> str:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    return code


def test_the_example_has_eight_lines():
    assert len([line for line in example().splitlines() if line]) == 8


def test_the_example_gives_depth_in_metres_for_every_camera(found: Any):
    assert found.depth.shape[0] == len(CAMERAS)
    assert found.pictures.shape == (*found.depth.shape, 3)
    assert found.present.all()
    known = np.isfinite(found.depth)
    assert known.mean() > 0.9
    assert 1 < np.median(found.depth[known]) < 40
