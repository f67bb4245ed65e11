# SPDX-License-Identifier: Apache-2.0
"""The training loop: what a run folder holds, what resuming computes, what a bad loss does."""

import json
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from repository import ROOT
from scenes import random_batch

from cvcdepth_core import processor
from cvcdepth_core.errors import CheckpointError, ConfigError, OutputError, TrainingError
from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.checkpoint import load_checkpoint, save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.config import OptimizerConfig, PoseConfig, TrainingConfig
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import Trainer, ValidationOutcome

SPEC = DepthModelSpec(encoder="efficientnet_lite0", height=64, width=64, min_depth=0.5, max_depth=80)


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class RandomBatches:
    """A few samples of a small rig; `missing` batches could not be read."""

    def __init__(self, missing: tuple[int, ...] = ()) -> None:
        self.samples = 4
        self._missing = missing

    def epoch(self, number, first=0):
        for position in range(first, self.samples):
            with torch.random.fork_rng(devices=[]):  # nothing of the steps' own draws may come from here
                torch.manual_seed(100 * number + position)
                batch = random_batch(1, 3, SPEC.height, SPEC.width).to(dtype=torch.float32)
            yield None if position in self._missing else batch


def config(checkpoint_every=100, **changes: Any):
    optimizer = OptimizerConfig(epochs=2, decay_after_epochs=1, samples_per_step=1, average_decay=0.9)
    pose = PoseConfig(encoder="efficientnet_lite0")
    optimizer = optimizer.model_copy(update=changes)
    return TrainingConfig(depth=SPEC, pose=pose, optimizer=optimizer, checkpoint_every=checkpoint_every)


def trainer(run, batches=None, **changes: Any):
    settings = config(**changes)
    return Trainer(settings, build_surround_model(settings), batches or RandomBatches(), run)


def log_of(run):
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    torch.set_num_threads(1)
    run = tmp_path_factory.mktemp("uninterrupted")
    trainer(run).train(quiet=True)
    return run


def test_a_run_leaves_a_checkpoint_a_log_and_its_configuration(uninterrupted):
    checkpoint = load_checkpoint(uninterrupted / "last.safetensors")
    assert checkpoint.spec == SPEC
    assert checkpoint.metadata["step"] == "8"
    assert checkpoint.pose_net
    log = log_of(uninterrupted)
    assert [entry["step"] for entry in log] == list(range(1, 9))
    assert {"temporal", "spatial", "depth_consistency"} <= log[0]["terms"].keys()
    assert [entry["learning_rate"] for entry in log] == pytest.approx([1e-4] * 4 + [1e-5] * 4)
    assert "learning_rate: 0.0001" in (uninterrupted / "config.yaml").read_text()


@pytest.mark.parametrize("kill_at", [1, 5])
def test_a_run_killed_at_any_moment_resumes_to_the_weights_of_an_uninterrupted_one(uninterrupted, tmp_path, kill_at):
    script = (
        "import sys, torch; from pathlib import Path; torch.set_num_threads(1); import test_training as t\n"
        "run = t.trainer(Path(sys.argv[1]), checkpoint_every=1)\n"
        "save = run.save\n"
        "run.save = lambda: (save(), print(run.progress.step, flush=True))\n"
        "run.train(quiet=True)\n"
    )
    folders = f"{Path(__file__).parent}:{ROOT / 'tests' / 'support'}:{ROOT}"
    process = subprocess.Popen(
        [sys.executable, "-c", script, tmp_path], stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": folders}
    )
    (tmp_path / f".state.pt.{process.pid}.tmp").write_bytes(b"of a process that was killed while it wrote")
    assert process.stdout is not None
    while int(process.stdout.readline()) < kill_at:
        pass
    time.sleep(random.uniform(0, 0.5))  # into a step, into writing, into the epoch's end
    process.send_signal(signal.SIGKILL)
    process.wait()
    resumed = trainer(tmp_path, checkpoint_every=1)
    assert not list(tmp_path.glob(".*.tmp"))
    assert kill_at <= resumed.progress.step <= 8
    resumed.train(quiet=True)
    expected, found = (load_checkpoint(run / "last.safetensors") for run in (uninterrupted, tmp_path))
    assert found.metadata == expected.metadata
    for networks in ("depth_net", "pose_net"):
        weights, same = getattr(expected, networks), getattr(found, networks)
        assert weights.keys() == same.keys()
        assert [name for name in weights if not torch.equal(weights[name], same[name])] == []
    assert [entry["step"] for entry in log_of(tmp_path)] == list(range(1, 9))


def test_a_finished_run_can_be_made_longer(uninterrupted, tmp_path):
    for name in ("state.pt", "log.jsonl"):
        (tmp_path / name).write_bytes((uninterrupted / name).read_bytes())
    longer = trainer(tmp_path, epochs=3)
    longer.train(quiet=True)
    assert longer.progress.step == 12


def test_a_folder_of_another_run_is_refused_by_what_differs(uninterrupted):
    with pytest.raises(CheckpointError, match=r"state.pt: was made with another configuration \(optimizer\)"):
        trainer(uninterrupted, learning_rate=1e-3)
    fewer = RandomBatches()
    fewer.samples = 3
    with pytest.raises(CheckpointError, match="from 4 samples, now there are 3"):
        trainer(uninterrupted, fewer)


def test_a_folder_of_a_run_that_was_made_from_something_else_is_refused_by_what_it_is(tmp_path):
    settings = config(epochs=1)

    def made_from(**inputs: str) -> Trainer:
        return Trainer(settings, build_surround_model(settings), RandomBatches(), tmp_path, inputs=inputs)

    made_from(start="a", rig="b").save()
    made_from(rig="b", start="a")
    with pytest.raises(CheckpointError, match=r"state.pt: was made from something else: start was a, now it is c; "):
        made_from(start="c", rig="b")
    with pytest.raises(CheckpointError, match="rig was b, now it is none; mask was none, now it is d"):
        made_from(start="a", mask="d")


@pytest.mark.parametrize("left", [0.0, 0.001, 0.5, 0.999])
def test_a_damaged_state_is_named(uninterrupted, tmp_path, left):
    content = (uninterrupted / "state.pt").read_bytes()
    (tmp_path / "state.pt").write_bytes(content[: int(left * len(content))])
    with pytest.raises(CheckpointError, match=r"state.pt: is (empty|damaged) .*remove it to start") as error:
        trainer(tmp_path)
    assert "\n" not in str(error.value)


def test_a_state_that_is_something_else_is_named(tmp_path):
    (tmp_path / "state.pt").write_bytes(b"x" * 1000)
    with pytest.raises(CheckpointError, match=r"state.pt: is damaged"):
        trainer(tmp_path)


def test_a_state_of_another_versions_configuration_is_named_in_one_line(uninterrupted, tmp_path):
    state = torch.load(uninterrupted / "state.pt", weights_only=True)
    state["config"] = state["config"].replace('"max_depth":200.0', '"flip_fusion":true')
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(CheckpointError, match=r"state.pt: its configuration .* evaluation.flip_fusion") as error:
        trainer(tmp_path)
    assert "\n" not in str(error.value)


def test_the_average_of_the_weights_is_what_is_saved_and_validated(tmp_path):
    settings = config(epochs=1)
    seen = []

    def validate(trainer):
        seen.append((trainer.result, trainer.result.training))
        return ValidationOutcome({"score": len(seen)})

    run = Trainer(settings, build_surround_model(settings), RandomBatches(), tmp_path, validate=validate)
    run.train(quiet=True)
    assert seen == [(run.result, False)] * 2  # before the first step and after the last
    assert [entry["validation"]["score"] for entry in log_of(tmp_path) if "validation" in entry] == [1, 2]
    saved = load_checkpoint(tmp_path / "last.safetensors").depth_net
    key = "depth_decoder.decoder.0.conv.conv.weight"
    assert torch.equal(saved[key], run.result.depth_net.state_dict()[key])
    assert not torch.equal(saved[key], run.model.depth_net.state_dict()[key])


class Watcher:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.steps, self.pictures, self.validations = [], [], []

    def on_step(self, trainer, entry):
        self.steps.append((trainer.progress.step, entry["loss"]))

    def on_pictures(self, trainer, batch, prediction):
        assert not prediction.depth.requires_grad
        self.pictures.append((trainer.progress.step, batch.frames.shape[0], tuple(prediction.motions.shape)))

    def on_validation(self, trainer, entry):
        self.validations.append(entry)


def watched(run, outcomes, watcher, **changes: Any):
    settings = config(**changes).model_copy(update={"pictures_every": 3})
    batches = RandomBatches()
    observers = () if watcher is None else (watcher,)
    return Trainer(
        settings,
        build_surround_model(settings),
        batches,
        run,
        validate=lambda _: outcomes.pop(0),
        observers=observers,
    )


def test_observers_are_told_of_steps_pictures_and_validations(tmp_path):
    watcher = Watcher()
    watched(tmp_path, [ValidationOutcome({"score": i}) for i in range(3)], watcher).train(quiet=True)
    steps, validations = ([entry for entry in log_of(tmp_path) if key in entry] for key in ("loss", "validation"))
    assert watcher.steps == [(entry["step"], entry["loss"]) for entry in steps]
    assert watcher.pictures == [(step, 1, (1, 2, 3, 4, 4)) for step in (1, 4, 7)]
    assert watcher.validations == validations
    assert [(entry["step"], entry["validation"]["score"], entry["stop"]) for entry in validations] == [
        (0, 0, False),
        (4, 1, False),
        (8, 2, False),
    ]


def test_a_validation_can_end_a_run_which_then_stays_ended(tmp_path):
    verdicts = [ValidationOutcome({"score": 1.0}), ValidationOutcome({"score": 0.5}, stop=True)]
    run = watched(tmp_path, verdicts, None)
    run.train(quiet=True)
    assert (run.progress.epoch, run.progress.step, run.progress.stopped) == (1, 4, True)
    assert log_of(tmp_path)[-1] == {"step": 4, "epoch": 1, "validation": {"score": 0.5}, "stop": True}
    again = watched(tmp_path, [], None)
    again.train(quiet=True)
    assert (again.progress.step, again.progress.stopped) == (4, True)
    assert again.validations == run.validations
    assert load_checkpoint(tmp_path / "last.safetensors").metadata["step"] == "4"


def test_the_log_of_a_killed_run_goes_on_without_what_was_lost(tmp_path):
    """As of a run that was killed after it had logged steps and a validation, but before it saved them."""
    run = watched(tmp_path, [ValidationOutcome({"score": 1.0})], None, epochs=1)
    run._score()
    run.save()
    lost = [{"step": 1, "epoch": 0, "loss": 0.3}, {"step": 1, "epoch": 1, "validation": {}, "stop": False}]
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write("\n".join(json.dumps(entry) for entry in lost) + '\n{"step": 2, "lo')
    watched(tmp_path, [ValidationOutcome({"score": 2.0})], None, epochs=1).train(quiet=True)
    assert [(entry["step"], "validation" in entry) for entry in log_of(tmp_path)] == [
        (0, True),
        *((step, False) for step in (1, 2, 3, 4)),
        (4, True),
    ]


class Trouble(Watcher):
    """Makes some after the log of a step."""

    def __init__(self, step: int, make: Callable[[], None]) -> None:
        super().__init__()
        self._step, self._make = step, make

    def on_step(self, trainer, entry):
        if entry["step"] == self._step:
            self._make()


def interrupt():
    raise KeyboardInterrupt


def forbid_large_files():
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write then fails with an error, as on a full disk
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


def allow_large_files():
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def test_a_full_disk_leaves_the_last_good_checkpoint_and_is_named(tmp_path):
    run = watched(tmp_path, [ValidationOutcome({})] * 9, Trouble(6, forbid_large_files))
    try:
        with pytest.raises(OutputError, match=r"state.pt: cannot be written: File too large"):
            run.train(quiet=True)
    finally:
        allow_large_files()
    assert load_checkpoint(tmp_path / "last.safetensors").metadata["step"] == "4"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "config.yaml",
        "last.safetensors",
        "log.jsonl",
        "state.pt",
    ]
    resumed = watched(tmp_path, [ValidationOutcome({})] * 9, None)
    assert resumed.progress.step == 4


def test_an_interrupted_run_leaves_the_last_good_checkpoint(tmp_path):
    run = watched(tmp_path, [ValidationOutcome({})] * 9, Trouble(6, interrupt))
    with pytest.raises(KeyboardInterrupt):
        run.train(quiet=True)
    assert load_checkpoint(tmp_path / "last.safetensors").metadata["step"] == "4"
    assert watched(tmp_path, [], None).progress.step == 4


@pytest.fixture
def with_bfloat16(monkeypatch):
    monkeypatch.setattr(processor, "instructions", lambda: frozenset({"avx2", "avx512_bf16"}))


@pytest.fixture
def without_bfloat16(monkeypatch):
    monkeypatch.setattr(processor, "instructions", lambda: frozenset({"avx2"}))


def test_networks_run_in_half_precision_while_the_weights_stay_whole(tmp_path, with_bfloat16):
    batches = RandomBatches()
    batches.samples = 1
    run = trainer(tmp_path, batches, epochs=1, autocast="bfloat16", average_decay=None)
    seen = []
    head = run.model.depth_net.depth_decoder.decoder[-1].conv
    head.register_forward_hook(lambda module, inputs, output: seen.append((module.weight.dtype, output.dtype)))
    run.train(quiet=True)
    assert seen == [(torch.float32, torch.bfloat16)]
    assert run.progress.skipped == 0
    assert log_of(tmp_path)[0]["loss"] > 0


def test_auto_is_what_the_cpu_is_quick_at_and_the_log_says_what_that_was(tmp_path, with_bfloat16):
    run = trainer(tmp_path, epochs=1, autocast="auto", average_decay=None)
    run.train(quiet=True)
    assert run.autocast == "bfloat16"
    assert {entry["autocast"] for entry in log_of(tmp_path)} == {"bfloat16"}
    exact = trainer(tmp_path / "exact", epochs=1, average_decay=None)
    exact.train(quiet=True)
    losses = zip(log_of(tmp_path), log_of(tmp_path / "exact"), strict=True)
    assert all(0 < abs(half["loss"] - whole["loss"]) < 0.01 for half, whole in losses)


def test_a_run_goes_on_in_the_precision_that_it_began_in(tmp_path, without_bfloat16, monkeypatch):
    run = trainer(tmp_path, epochs=1, autocast="auto")
    run.train(quiet=True)
    assert run.autocast == "none"
    monkeypatch.setattr(processor, "instructions", lambda: frozenset({"amx_bf16"}))
    assert trainer(tmp_path, autocast="auto").autocast == "none"
    assert trainer(tmp_path / "new", autocast="auto").autocast == "bfloat16"


def test_bfloat16_is_refused_where_it_would_be_slow(tmp_path, without_bfloat16, monkeypatch):
    with pytest.raises(ConfigError, match=r"optimizer.autocast is bfloat16.*this CPU does not multiply bfloat16"):
        trainer(tmp_path, autocast="bfloat16")
    monkeypatch.setattr(processor, "instructions", lambda: frozenset({"avx512_bf16"}))
    trainer(tmp_path, epochs=1, autocast="auto").train(quiet=True)
    monkeypatch.setattr(processor, "instructions", lambda: frozenset({"avx2"}))
    with pytest.raises(ConfigError, match=r"auto and the run began with it"):
        trainer(tmp_path, autocast="auto")


def test_compiling_without_a_compiler_is_refused_by_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ConfigError, match=r"optimizer.compile is true.*'no-such-compiler' is not there"):
        trainer(tmp_path, compile=True)


def test_unreadable_batches_are_passed_over_and_counted(tmp_path):
    run = trainer(tmp_path, RandomBatches(missing=(1, 2)), samples_per_step=2, epochs=1)
    run.train(quiet=True)
    assert (run.progress.step, run.progress.skipped, run.progress.unreadable) == (2, 0, 2)
    assert all(entry["loss"] > 0 for entry in log_of(tmp_path))


def test_a_loss_that_is_not_finite_changes_no_weight_and_ends_a_run_when_it_stays(tmp_path):
    run = trainer(tmp_path, epochs=9)
    before = {name: value.clone() for name, value in run.model.named_parameters()}
    head = run.model.depth_net.depth_decoder.decoder[-1].conv.bias
    with torch.no_grad():
        head.fill_(float("nan"))
    with pytest.raises(TrainingError, match=r"step 20: .* 20 steps in a row.*last.safetensors"):
        run.train(quiet=True)
    assert run.progress.skipped == 20
    for name, value in run.model.named_parameters():
        assert value is head or torch.equal(value, before[name])


def test_the_gradient_of_a_step_is_the_mean_over_its_samples_however_they_are_batched(tmp_path):
    run = trainer(tmp_path)
    weight = run.model.pose_net.pose_decoder.net[0].weight
    for samples in (1, 4):
        weight.grad = torch.full_like(weight, 6.0)
        run._mean_gradient_norm(samples)
        assert float(weight.grad.mean()) == pytest.approx(6 / samples)


def test_a_long_gradient_is_shortened_and_its_length_is_told(tmp_path):
    run = trainer(tmp_path, max_gradient_norm=0.5)
    weight = run.model.pose_net.pose_decoder.net[0].weight
    weight.grad = torch.ones_like(weight)
    assert run._mean_gradient_norm(1) == pytest.approx(weight.numel() ** 0.5)
    assert float(weight.grad.norm()) == pytest.approx(0.5, rel=1e-4)


def test_training_starts_from_a_checkpoint_of_the_same_meaning_only(tmp_path):
    torch.manual_seed(7)
    network = DepthNet(SPEC.encoder)
    save_checkpoint(tmp_path / "start.safetensors", SPEC.model_copy(update={"height": 128}), network.state_dict())
    model = build_surround_model(config(), load_checkpoint(tmp_path / "start.safetensors"))
    key = "depth_decoder.decoder.0.conv.conv.weight"
    assert torch.equal(model.depth_net.state_dict()[key], network.state_dict()[key])
    save_checkpoint(tmp_path / "other.safetensors", SPEC.model_copy(update={"max_depth": 200}), network.state_dict())
    with pytest.raises(CheckpointError, match=r"other.safetensors: max_depth is 200.*depth.max_depth is 80"):
        build_surround_model(config(), load_checkpoint(tmp_path / "other.safetensors"))
