# SPDX-License-Identifier: Apache-2.0
"""Several processes compute what one computes: two of them, over gloo, on this machine's CPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from repository import ROOT
from shared_training import train

from cvcdepth_core.training.distributed import Processes, own_device, share_batch_statistics

TESTS = ROOT / "tests" / "support"


def torchrun(processes: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    return subprocess.run(
        [*command, "-m", *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": f"{TESTS}:{TESTS.parent}", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def log_of(run: Path, keyword: str) -> list[dict[str, object]]:
    entries = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [entry for entry in entries if keyword in entry]


def state_of(run: Path) -> dict[str, torch.Tensor]:
    state = torch.load(run / "state.pt", weights_only=True)
    return {f"{part}.{name}": value for part in ("model", "average") for name, value in state[part].items()}


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A run of one process with two samples per batch."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    run = tmp_path_factory.mktemp("alone")
    train(run, epochs=3, samples_per_batch=2, processes=Processes())
    torch.set_num_threads(threads)
    return run


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """The same by two processes with one sample each, up to the first epoch's end."""
    run = tmp_path_factory.mktemp("shared")
    finished = torchrun(2, "shared_training", run, 1, 1)
    assert finished.returncode == 0, finished.stderr
    return run


def test_two_processes_make_the_steps_of_one_with_twice_the_batch(alone, shared):
    first = [entry for entry in log_of(alone, "loss") if entry["epoch"] == 0]
    second = log_of(shared, "loss")
    assert [entry["samples"] for entry in second] == [4, 2]  # of the pair with a damaged picture, neither is used
    for one, other in zip(first, second, strict=True):
        for name in ("step", "samples", "loss", "gradient_norm", "learning_rate"):
            assert other[name] == pytest.approx(one[name], rel=1e-9), name
        assert other["terms"] == pytest.approx(one["terms"], rel=1e-9)


def test_every_step_rehearses_and_tells_its_terms_apart(shared):
    for entry in log_of(shared, "loss"):
        assert {"temporal", "spatial"} < set(entry["terms"])
        assert {name for name in entry["terms"] if name.startswith("worlds_")} == REHEARSED
    assert not {"truth", "truth_sky"} & set(entry["terms"])


REHEARSED = {f"worlds_{name}" for name in ("truth", "truth_shape", "truth_outlines", "truth_sky")}


def test_a_run_of_two_processes_goes_on_with_one_to_the_same_weights(alone, shared):
    torch.set_num_threads(1)
    train(shared, epochs=3, samples_per_batch=2, processes=Processes())
    assert [entry["step"] for entry in log_of(shared, "loss")] == list(range(1, 5))
    expected, found = state_of(alone), state_of(shared)
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-6, atol=1e-8, msg=name)


def test_the_first_process_alone_validates_and_all_obey(shared):
    validations = log_of(shared, "validation")
    assert [entry["validation"] for entry in validations] == [{"rank": 0}] * 3
    assert [(entry["epoch"], entry["stop"]) for entry in validations] == [(0, False), (1, False), (2, True)]


def test_processes_that_cannot_share_a_step_evenly_are_refused(tmp_path):
    finished = torchrun(3, "shared_training", tmp_path / "run", 1, 1)
    assert finished.returncode == 1
    assert "samples_per_step is 4, expected a multiple of 3: samples_per_batch (1) x 3 processes" in finished.stderr


def test_without_torchrun_a_process_is_alone_and_takes_the_device_it_is_told():
    assert Processes().is_first
    assert own_device(torch.device("cuda")) == torch.device("cuda")


def test_sharing_statistics_keeps_the_names_of_the_weights_and_the_evaluation():
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 1), torch.nn.BatchNorm2d(4)).eval()
    images = torch.rand(2, 3, 5, 6)
    names, answer = list(network.state_dict()), network(images)
    shared_network = share_batch_statistics(network, torch.device("cpu"))
    assert list(shared_network.state_dict()) == names
    assert torch.equal(shared_network(images), answer)
