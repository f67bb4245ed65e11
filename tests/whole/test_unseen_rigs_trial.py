# SPDX-License-Identifier: Apache-2.0
"""`tools/unseen_rigs.py`: rigs made of other views fit their pictures, what is told wrongly leaves truth alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import SAMPLE
from repository import ROOT, load_tool

from cvcdepth_core.engines.example_rigs import ring_of_pictures
from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.rig import RecordedRig

TOOL = load_tool("unseen_rigs")
DRIVE = ROOT / "samples" / "world_excerpt"
SPEC = DepthModelSpec(
    network="rig_conditioned", encoder="efficientnet_lite0", height=64, width=96, min_depth=0.4, max_depth=250.0,
    focal_scale=48.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def estimator() -> DepthEstimator:
    return DepthEstimator.untrained(SPEC, "cpu", backend="torch_eager")


@pytest.fixture(scope="module")
def layout() -> RigLayout:
    with open_recording(SAMPLE) as recording:
        return RecordedRig.from_recording(recording).layout


@pytest.mark.parametrize("name", [name for name in TOOL.SHOWN_BY if name != "upside down"])
def test_what_a_view_shows_of_a_point_is_what_the_camera_shows_of_it(layout: RigLayout, name: str):
    """Through the raw picture: a pixel of the view, and the pixel of the camera that shows the same ray."""
    shown = TOOL.shown_by(layout, TOOL.SHOWN_BY[name])
    for one, other in zip(layout.complete().cameras, shown.complete().cameras, strict=True):
        point = one.base_T_camera[:3, :3] @ [0.2, 0.1, 5.0]
        rays = [camera.base_T_camera[:3, :3].T @ point for camera in (one, other)]
        raw = [camera.calibration.rotation.T @ ray for camera, ray in zip((one, other), rays, strict=True)]
        np.testing.assert_allclose(raw[0], raw[1], atol=1e-9)
        np.testing.assert_allclose(one.base_T_camera[:3, 3], other.base_T_camera[:3, 3])


def test_a_view_that_is_tilted_down_looks_down_and_one_cut_aside_looks_aside(layout: RigLayout):
    front = layout.complete().cameras[layout.names.index("front")]
    down = TOOL.view_of(layout.cameras[layout.names.index("front")], TOOL.Shown(pitch=8))
    assert down.base_T_camera.matrix("front")[2, 2] == pytest.approx(
        front.base_T_camera[2, 2] - np.sin(np.radians(8)), abs=0.01
    )
    aside = TOOL.view_of(layout.cameras[0], TOOL.Shown(aside=0.2)).calibration
    assert aside.rectified_intrinsics[0, 2] == pytest.approx(0.3 * aside.width, abs=1)


def test_what_is_told_wrongly_changes_what_the_network_is_told_alone():
    pictures, random = ring_of_pictures(64, 96), np.random.default_rng(0)
    higher = TOOL.CHANGES["cameras told 10 % higher"](pictures, random)
    np.testing.assert_allclose(higher.base_T_camera[:, 2, 3], 1.1 * pictures.base_T_camera[:, 2, 3])
    down = TOOL.CHANGES["pitch told 2 degrees down"](pictures, random)
    np.testing.assert_allclose(np.degrees(np.arcsin(down.base_T_camera[:, 2, 2])), -2, atol=1e-6)
    dark = TOOL.CHANGES["night"](pictures, random)
    assert dark.pictures.mean() < 0.7 * pictures.pictures.mean()
    for changed in (higher, down):
        assert changed.pictures is pictures.pictures
    assert dark.base_T_camera is pictures.base_T_camera


def options(folder: Path) -> Any:
    return TOOL.sources(
        TOOL.argparse.Namespace(worlds=[str(DRIVE)], street=str(SAMPLE), rig=None, start=0.0, every=10, output=folder)
    )


def test_it_scores_each_case_once_and_the_upside_down_rig_is_refused(
    estimator: DepthEstimator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(TOOL, "CHANGES", {"blur": TOOL.CHANGES["blur"]})
    monkeypatch.setattr(TOOL, "SHOWN_BY", {name: TOOL.SHOWN_BY[name] for name in ("upside down",)})
    kept = TOOL.Rows(tmp_path / "rows.jsonl", "toy")
    for source in options(tmp_path):
        TOOL.score_source(source, estimator, kept)
    lines = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert len(lines) == 5
    refused = next(row for row in map(json.loads, lines) if row["case"] == "upside down")
    assert "is mounted upside down by its transform" in refused["refused"]
    again = TOOL.Rows(tmp_path / "rows.jsonl", "toy")
    monkeypatch.setattr(TOOL, "read", None)
    for source in options(tmp_path):
        TOOL.score_source(source, estimator, again)
    tables = "\n".join(TOOL.markdown(again.rows))
    assert "| world_excerpt | " in tables
    assert "| upside down | refused: camera " in tables
    assert TOOL.Rows(tmp_path / "rows.jsonl", "other weights").rows == []
