# SPDX-License-Identifier: Apache-2.0
"""`evaluate --ray`: recordings handed to a Ray cluster, a real one on this machine."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import recordings
from repository import ROOT

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.evaluation.cluster import ray_pool
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import RecordingScores
from cvcdepth_ros.evaluation.result import Failure
from cvcdepth_ros.evaluation.workers import Pool, evaluate_all

SETTINGS = EvaluationSettings(predictor="constant", height=64, width=96)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings, and a file that is none."""
    folder = tmp_path_factory.mktemp("drives")
    for name, sets in (("one", 1), ("two", 2)):
        recordings.write_mcap(folder / f"{name}.mcap", recordings.sample_entries(sets))
    (folder / "none.mcap").write_bytes(b"this was never a recording")
    return folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "net.safetensors"
    spec = DepthModelSpec(height=64, width=96, min_depth=1.5, max_depth=200.0)
    save_checkpoint(path, spec, DepthNet("resnet18").state_dict())
    return path


@pytest.fixture(scope="module")
def pool(checkpoint: Path) -> Iterator[Pool]:
    """A cluster on this machine, connected to by this process."""
    pytest.importorskip("ray", reason="no Ray in this environment")
    # Not pytest's folder: Ray puts sockets there, whose paths must be short.
    folder = tempfile.mkdtemp(prefix="ray_")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
        with ray_pool(EvaluationSettings(checkpoint=str(checkpoint), device="cpu"), None, 2) as pool:
            yield pool
    shutil.rmtree(folder)


def evaluate(*arguments: str) -> list[str]:
    constant = ["--predictor", "constant", "--height", "64", "--width", "96", "--no-report", "--quiet"]
    return ["evaluate", *arguments, *constant]


class DeadlyJob(EvaluationJob):
    """Whoever receives it dies at once, as a process does that the kernel kills for want of memory."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (9,)


def test_a_ray_worker_that_dies_costs_its_own_recording_only(pool: Pool, drives: Path, checkpoint: Path):
    settings = EvaluationSettings(checkpoint=str(checkpoint), device="cpu")
    jobs = [cls(cls.__name__, str(drives / "one.mcap"), settings) for cls in (DeadlyJob, EvaluationJob)]
    found = {job.name: outcome for job, outcome in evaluate_all(jobs, pool=pool)}
    failure, scores = found["DeadlyJob"], found["EvaluationJob"]
    assert isinstance(failure, Failure)
    assert "died" in failure.reason
    assert isinstance(scores, RecordingScores)
    assert scores.summary["sets"]["scored"] == 1


def test_a_machine_with_another_checkpoint_at_that_path_is_named(pool: Pool, drives: Path, tmp_path: Path):
    other, missing = tmp_path / "other.safetensors", tmp_path / "missing.safetensors"
    spec = DepthModelSpec(height=64, width=96, min_depth=1.5, max_depth=200.0)
    save_checkpoint(other, spec, DepthNet("resnet18").state_dict())
    one = EvaluationJob("", str(drives / "one.mcap"), EvaluationSettings(device="cpu"))
    settings = [EvaluationSettings(checkpoint=str(path), device="cpu") for path in (other, missing)]
    jobs = [replace(one, name=name, settings=found) for name, found in zip("ab", settings, strict=True)]
    outcomes = {job.name: outcome for job, outcome in evaluate_all(jobs, pool=pool)}
    assert all(isinstance(outcome, Failure) for outcome in outcomes.values())
    assert "sha256" in outcomes["a"].reason
    assert "expected" in outcomes["a"].reason
    assert "missing.safetensors: no such file" in outcomes["b"].reason


def test_a_cluster_gives_exactly_the_files_of_one_worker(pool: Pool, drives: Path, tmp_path: Path):
    """As another process does it that connects to the cluster by its address, relative paths included."""
    import ray

    address = ray.get_runtime_context().gcs_address
    assert main(evaluate(str(drives), "-o", str(tmp_path / "one"))) == 0
    program = [sys.executable, "-m", "cvcdepth_ros.bag_replay"]
    command = [*program, *evaluate(".", "-o", str(tmp_path / "ray"), "--ray-address", address, "--json")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=drives, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["sets"] == 3
    assert len(list((tmp_path / "ray" / "parts").iterdir())) == 2
    metrics = [(tmp_path / name / "metrics.json").read_text() for name in ("one", "ray")]
    assert metrics[0].replace(f"{drives}/", "") == metrics[1]
    assert (tmp_path / "one" / "per_frame.csv").read_bytes() == (tmp_path / "ray" / "per_frame.csv").read_bytes()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "nowhere"])
def test_a_cluster_that_cannot_be_reached_is_named(address: str):
    pytest.importorskip("ray", reason="no Ray in this environment")
    with (
        pytest.raises(ConfigError, match=f"Ray cluster {address}: cannot be reached: "),
        ray_pool(SETTINGS, address, None),
    ):
        pass


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install 'cvcdepth_ros\[fleet\]'"), ray_pool(SETTINGS, None, None):
        pass


def test_workers_of_a_cluster_elsewhere_are_not_counted_here(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(evaluate(str(tmp_path), "--ray-address", "10.0.0.1:6379", "--workers", "2"))
    assert "--workers is for this machine" in capsys.readouterr().err
