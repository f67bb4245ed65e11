# SPDX-License-Identifier: Apache-2.0
"""`cvcdepth bench` over real DDS, at the smallest size that means anything."""

import json
from collections.abc import Iterator

import pytest
from domains import own_domain
from recordings import SAMPLE

from cvcdepth_ros.bag_replay import main

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

SMALL = ("--untrained", "--height", "64", "--width", "96", "--seconds", "4", "--rate", "0.5")


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with own_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield


def test_one_line_compares_the_node_with_the_baseline(capsys: pytest.CaptureFixture[str]):
    assert main(["bench", str(SAMPLE), *SMALL]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    for found in (result, result["baseline"]):
        assert 3 <= found["sets_received"] <= found["sets_sent"]
        assert 0 < found["median_ms"] <= found["p95_ms"]
        assert 0 < found["age_ms"]["p50"] <= found["age_ms"]["max"]
        assert 0 <= found["outside_inference"] < 1
        assert found["peak_memory_mb"] > 50
        assert {"decode", "preprocess", "inference", "postprocess", "publish"} <= found["stages_ms"].keys()
    assert "torch_eager" in result["baseline"]["engine"]
    assert result["times_baseline"] == pytest.approx(result["baseline"]["median_ms"] / result["median_ms"], rel=0.01)


def test_a_recording_without_cameras_is_named(tmp_path, capsys: pytest.CaptureFixture[str]):
    assert main(["bench", str(tmp_path / "none"), *SMALL]) == 1
    assert str(tmp_path / "none") in capsys.readouterr().err
