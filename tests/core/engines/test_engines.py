# SPDX-License-Identifier: Apache-2.0
"""The engines: equal to the network, independent of the batch, refused when they are not what they should be."""

import copy
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cvcdepth_core.engines import build_engine, is_installed, openvino_engine, selection
from cvcdepth_core.engines.engine import DeviceMemoryError
from cvcdepth_core.engines.example_rigs import ring_of_cameras
from cvcdepth_core.engines.guarded_engine import GuardedEngine
from cvcdepth_core.engines.ncnn_graph import ncnn_model
from cvcdepth_core.engines.parity import check_parity, relative_depth_error
from cvcdepth_core.engines.rewriting import RewrittenDepthNet
from cvcdepth_core.engines.torch_engine import MixedPrecision, PaddedBatches, TorchEagerEngine, TorchEngine
from cvcdepth_core.errors import ConfigError, EngineError
from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.images.surround import to_tensor
from cvcdepth_core.model_choices import ENCODERS, Precision
from cvcdepth_core.networks import DepthNet, RigImages, disparity_to_depth
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.bag_replay import main

HEIGHT, WIDTH = 64, 96
KINDS = ("resnet18", "efficientnet_lite0")
"""Encoders that differ in more than their number of blocks."""
CPU = torch.device("cpu")
CPU_BACKENDS = [
    pytest.param(name, marks=pytest.mark.skipif(not is_installed(name), reason=f"{name} is not installed"))
    for name in ("torch_eager", "torch", "ncnn", "openvino", "onnxruntime")
]
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
needs_openvino = pytest.mark.skipif(not is_installed("openvino"), reason="onnx or openvino is not installed")
needs_ncnn = pytest.mark.skipif(not is_installed("ncnn"), reason="ncnn is not installed")


def lively_network(encoder: str) -> DepthNet:
    """Random weights and running statistics, so that every layer matters and disparity varies."""
    return copy.deepcopy(_lively_network(encoder))


@lru_cache
def _lively_network(encoder: str) -> DepthNet:
    generator = torch.Generator().manual_seed(0)
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        network = DepthNet(encoder).eval()
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                for tensor, low in ((module.weight, 0.5), (module.running_var, 0.5), (module.running_mean, -0.2)):
                    tensor.copy_(torch.rand(tensor.shape, generator=generator) * 0.8 + low)
                module.bias.copy_(torch.randn(module.bias.shape, generator=generator) * 0.1)
        for parameter in network.depth_decoder.parameters():
            parameter.mul_(1.8)
    return network


def spec_of(encoder: str) -> DepthModelSpec:
    return DepthModelSpec(encoder=encoder, height=HEIGHT, width=WIDTH, min_depth=0.5, max_depth=100.0)


def random_images(count: int) -> Tensor:
    return torch.rand(count, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))


def random_pictures(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(2)
    return list(rng.integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8))


def surround_of(pictures: list[np.ndarray], fx: np.ndarray | None = None) -> SurroundPictures:
    """One set, all of whose cameras are present; an independent network asks for fx alone."""
    count = len(pictures)
    intrinsics = np.tile(np.eye(3), (count, 1, 1))
    intrinsics[:, 0, 0] = 60.0 if fx is None else fx
    valid, mounts = np.ones((count, HEIGHT, WIDTH), bool), np.tile(np.eye(4), (count, 1, 1))
    return SurroundPictures(np.stack(pictures), np.ones(count, bool), intrinsics, mounts, valid)


def rig_of(images: Tensor) -> RigImages:
    rig = RigImages.from_pictures(surround_of(random_pictures(len(images))))
    return rig._replace(images=images[None])


@pytest.mark.parametrize("transposed", [True, False])
@pytest.mark.parametrize("encoder", ENCODERS)
@torch.inference_mode()
def test_the_rewritten_network_is_the_network(encoder: str, transposed: bool):
    network = lively_network(encoder)
    images = random_images(2).double()
    exact = network.double().disparity(images)
    assert exact.std() > 0.001
    rewritten = RewrittenDepthNet(network, transposed)
    torch.testing.assert_close(rewritten(images), exact, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(rewritten.float()(images.float()).double(), exact, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_the_rewritten_network_neither_normalises_nor_stretches_nor_joins(encoder: str):
    network = lively_network(encoder)
    rewritten = RewrittenDepthNet(network)
    assert not [m for m in rewritten.modules() if isinstance(m, (nn.BatchNorm2d, nn.Upsample))]
    operations = {event.key for event in operations_of(rewritten)}
    assert "aten::cat" in {event.key for event in operations_of(network)}
    assert not operations & {"aten::cat", "aten::upsample_nearest2d", "aten::batch_norm"}


def operations_of(network: nn.Module) -> list:
    with torch.inference_mode(), torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        getattr(network, "disparity", network)(random_images(1))
    return list(profile.key_averages())


def test_rewriting_leaves_the_network_as_it_was():
    network = lively_network("resnet18")
    before = copy.deepcopy(network.state_dict())
    RewrittenDepthNet(network)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert all(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize("encoder", KINDS)
@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_every_engine_gives_the_depth_of_float64(backend: str, encoder: str):
    network, spec = lively_network(encoder), spec_of(encoder)
    engine = selection.checked_engine(network, spec, CPU, backend, "float32")
    assert backend in engine.name
    assert relative_depth_error(engine, network, spec, rig_of(random_images(1))) < 1e-4


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_a_cameras_depth_does_not_depend_on_the_other_cameras(backend: str):
    estimator = DepthEstimator(lively_network("resnet18"), spec_of("resnet18"), "random", "cpu", backend)
    pictures, fx = random_pictures(3), np.array([60.0, 70.0, 80.0])
    together = estimator.estimate(surround_of(pictures, fx))
    alone = [estimator.estimate(surround_of([picture], fx[[index]]))[0] for index, picture in enumerate(pictures)]
    reversed_order = estimator.estimate(surround_of(pictures[::-1], fx[::-1]))[::-1]
    assert together.dtype == np.float32
    assert np.array_equal(together, np.stack(alone))
    assert np.array_equal(together, reversed_order)


class WrongEngine(TorchEagerEngine):
    """Its disparity is some per mille off, or not a number."""

    factor = 1.002

    def disparity(self, rig: RigImages) -> Tensor:
        return super().disparity(rig) * self.factor


@pytest.mark.parametrize("factor", [1.002, 0.99, float("nan")])
def test_an_engine_that_gives_another_depth_is_refused_with_the_numbers(factor: float):
    network, spec = lively_network("resnet18"), spec_of("resnet18")
    engine = WrongEngine(network, CPU)
    engine.factor = factor
    found = relative_depth_error(engine, network, spec, ring_of_cameras(HEIGHT, WIDTH).of_cameras([0]))
    with pytest.raises(EngineError, match=rf"torch_eager .* is {found:.2e} at the 99.9th percentile .* at most 0.001"):
        check_parity(engine, network, spec, "float32")


def test_the_check_happens_when_an_estimator_is_built(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(selection, "TorchEngine", lambda network, device, *_, **__: WrongEngine(network, device))
    with pytest.raises(EngineError, match="relative depth error against float64"):
        DepthEstimator(lively_network("resnet18"), spec_of("resnet18"), "random", "cpu", "torch")


def test_auto_takes_ncnn_where_it_is_installed_and_torch_where_it_is_not(monkeypatch: pytest.MonkeyPatch):
    network, spec = lively_network("resnet18"), spec_of("resnet18")
    best = "ncnn" if is_installed("ncnn") else "torch"
    assert build_engine(network, spec, "cpu").name.startswith(best)
    monkeypatch.setattr(selection, "find_spec", lambda _: None)
    assert build_engine(network, spec, "cpu").name.startswith("torch ")


@pytest.mark.parametrize(
    ("encoder", "flags", "first"),
    [
        ("efficientnet_lite0", {"avx2", "avx512f"}, ["openvino", "ncnn", "torch"]),
        ("efficientnet_lite0", {"avx2"}, ["ncnn", "openvino", "torch"]),
        ("resnet18", {"avx2", "avx512f"}, ["ncnn", "openvino", "torch"]),
    ],
)
def test_auto_prefers_openvino_where_it_was_found_quicker(
    encoder: str, flags: set[str], first: list[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(selection, "find_spec", lambda _: True)
    monkeypatch.setattr(selection, "instructions", lambda: frozenset(flags))
    chosen = selection.choices_of_auto(DepthNet(encoder), spec_of(encoder), CPU)
    assert chosen == [*first, "onnxruntime", "torch_eager"]
    assert selection.choices_of_auto(DepthNet(encoder), spec_of(encoder), torch.device("cuda"))[0] == "torch"


def test_auto_passes_over_an_engine_that_is_broken_and_says_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def build(backend: str, *others: object) -> object:
        if backend in ("ncnn", "openvino"):
            raise EngineError(f"backend {backend}: libc++.so.9: cannot open shared object file")
        return built(backend, *others)

    built = selection._build
    monkeypatch.setattr(selection, "_build", build)
    monkeypatch.setattr(selection, "find_spec", lambda name: name in ("ncnn", "onnx", "openvino") or None)
    network, spec = lively_network("resnet18"), spec_of("resnet18")
    assert build_engine(network, spec, "cpu").name.startswith("torch ")
    assert [record.getMessage() for record in caplog.records] == [
        f"backend auto: backend {name}: libc++.so.9: cannot open shared object file; going on with the next best"
        for name in ("ncnn", "openvino")
    ]
    with pytest.raises(EngineError, match=r"libc\+\+\.so\.9"):
        build_engine(network, spec, "cpu", "ncnn")


@needs_ncnn
@pytest.mark.parametrize("fault", ["cannot be imported", "nowhere to write"])
def test_auto_goes_on_where_ncnn_is_broken_or_has_nowhere_to_write(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(selection, "find_spec", lambda name: name == "ncnn" or None)
    if fault == "cannot be imported":
        monkeypatch.setitem(sys.modules, "ncnn", None)
    else:
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    network, spec = lively_network("resnet18"), spec_of("resnet18")
    assert build_engine(network, spec, "cpu").name.startswith("torch ")
    (record,) = caplog.records
    place = "ncnn" if fault == "cannot be imported" else str(tmp_path / "gone")
    found = record.getMessage()
    assert found.startswith("backend auto: backend ncnn: cannot be made ready: ")
    assert place in found.partition("ready:")[2]
    assert "\n" not in found
    with pytest.raises(EngineError, match="backend ncnn: cannot be made ready"):
        build_engine(network, spec, "cpu", "ncnn")


def test_an_openvino_that_cannot_be_imported_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch):
    def fail(name: str) -> None:
        raise ImportError(f"lib{name}.so: undefined symbol\n  more about it")

    monkeypatch.setattr(openvino_engine.importlib, "import_module", fail)
    with pytest.raises(EngineError, match=r"^backend openvino: .*cannot be imported: libopenvino\.so: undefined.*it$"):
        openvino_engine.OpenVinoEngine(lively_network("resnet18"), spec_of("resnet18"))


@needs_openvino
def test_openvino_leaves_the_stack_of_signals_as_it_was():
    """Else a child that ends, after the engine is gone, ends this process too: faulthandler's stack was replaced."""
    script = (
        "import faulthandler, gc, signal, subprocess, sys, torch\n"
        "faulthandler.enable()\n"
        "signal.signal(signal.SIGCHLD, lambda *_: None)\n"
        "from cvcdepth_core.engines.openvino_engine import OpenVinoEngine, _SignalStack\n"
        "import ctypes\n"
        "def stack():\n"
        "    found = _SignalStack()\n"
        "    ctypes.CDLL(None).sigaltstack(None, ctypes.byref(found))\n"
        "    return found.pointer\n"
        "from cvcdepth_core.networks.depth import DepthNet\n"
        "from cvcdepth_core.networks.registry import DepthModelSpec\n"
        "before = stack()\n"
        "spec = DepthModelSpec(encoder='efficientnet_lite0', height=64, width=96, min_depth=1.5, max_depth=200.0)\n"
        "engine = OpenVinoEngine(DepthNet('efficientnet_lite0').eval(), spec)\n"
        "engine._queue_for({'images': torch.zeros(2, 3, 64, 96)})\n"
        "print(stack() == before)\n"
        "del engine; gc.collect()\n"
        "subprocess.run([sys.executable, '-c', ''], check=True)\n"
        "print('alive')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["True", "alive"], done.stderr


@needs_openvino
def test_openvino_is_loaded_without_its_telemetry():
    script = (
        "import sys\nfrom cvcdepth_core.engines.openvino_engine import _import_openvino\n"
        "_import_openvino()\nprint(any(sys.modules[name] for name in sys.modules if 'openvino_telemetry' in name))"
    )
    found = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    assert found.stdout == "False\n"


@pytest.mark.parametrize(
    ("backend", "package"), [("ncnn", "ncnn"), ("onnxruntime", "onnx, onnxruntime"), ("openvino", "onnx, openvino")]
)
def test_an_engine_that_is_not_installed_is_refused_with_the_remedy(
    backend: str, package: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(selection, "find_spec", lambda _: None)
    with pytest.raises(EngineError, match=f"backend {backend}: {package} is not installed here: pip install"):
        build_engine(lively_network("resnet18"), spec_of("resnet18"), "cpu", backend)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "tensorflow"}, "backend is 'tensorflow', expected one of auto, ncnn, openvino, torch"),
        ({"backend": "tensorrt"}, "backend tensorrt runs on cuda only, the device is 'cpu'"),
        ({"backend": "torch_compiled"}, "backend torch_compiled runs on cuda only"),
        ({"backend": "torch", "precision": "float16"}, "precision float16 needs a CUDA device .* found backend torch"),
        ({"device": "cuda:99"}, "device: 'cuda:99' is not available"),
    ],
)
def test_what_does_not_go_together_is_refused(options: dict[str, str], message: str):
    with pytest.raises(ConfigError, match=message):
        build_engine(lively_network("resnet18"), spec_of("resnet18"), **({"device": "cpu"} | options))


class FaultyDevice:
    """An engine whose device takes `room` images at a time; there is no such device here."""

    name = "faulty"
    device = CPU
    chunk = None

    def __init__(self, room: int, error: Exception) -> None:
        self.room, self.error, self.tried = room, error, []

    def disparity(self, rig: RigImages) -> Tensor:
        cameras = rig.images.shape[1]
        self.tried.append(cameras)
        if cameras > self.room:
            raise self.error
        return rig.images[:, :, :1]


NO_ROOM = DeviceMemoryError("no room\nat all")
LOST = RuntimeError("CUDA error: unspecified launch failure\nCompile with TORCH_USE_CUDA_DSA")


@pytest.mark.parametrize("error", [NO_ROOM, torch.cuda.OutOfMemoryError()])
def test_with_little_memory_cameras_go_in_smaller_chunks_and_stay_there(error: Exception):
    small = FaultyDevice(2, error)
    engine = GuardedEngine(small, independent=True)
    assert engine.disparity(surround_of(random_pictures(6))).shape == (6, 1, HEIGHT, WIDTH)
    assert small.tried == [6, 3, 1, 1, 1, 1, 1, 1]
    small.tried.clear()
    engine.disparity(surround_of(random_pictures(2)))
    assert small.tried == [1, 1]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (NO_ROOM, "faulty on cpu: out of memory with a single picture: no room"),
        (LOST, "faulty on cpu: failed: CUDA error: unspecified launch failure"),
        (EngineError("onnxruntime: CUDA failure 700"), "faulty on cpu: failed: onnxruntime: CUDA failure 700"),
        (RuntimeError(), "faulty on cpu: failed: RuntimeError"),
    ],
)
def test_a_device_that_fails_stops_with_the_reason(error: Exception, reason: str):
    with pytest.raises(EngineError) as found:
        GuardedEngine(FaultyDevice(0, error), independent=True).disparity(surround_of(random_pictures(3)))
    assert str(found.value) == reason


@pytest.mark.parametrize("error", [NO_ROOM, LOST])
def test_where_that_is_wanted_the_cpu_takes_over_for_good(error: Exception):
    network, faulty = lively_network("resnet18"), FaultyDevice(0, error)
    engine = GuardedEngine(faulty, independent=True, fallback=lambda: TorchEagerEngine(network, CPU))
    pictures = random_pictures(2)
    with torch.inference_mode():
        expected = torch.cat([network.disparity(to_tensor([picture])) for picture in pictures])
    assert torch.equal(engine.disparity(surround_of(pictures)), expected)
    assert engine.name.startswith("torch_eager")
    faulty.tried.clear()
    engine.disparity(surround_of(pictures))
    assert not faulty.tried


@pytest.mark.parametrize("error", [NO_ROOM, LOST])
def test_a_fallback_that_fails_too_is_an_error(error: Exception):
    engine = GuardedEngine(FaultyDevice(0, error), independent=True, fallback=lambda: FaultyDevice(0, error))
    with pytest.raises(EngineError, match=r"out of memory|launch failure"):
        engine.disparity(surround_of(random_pictures(2)))


def test_a_compiled_network_sees_few_sizes_of_batch_while_cameras_come_and_go():
    network, seen = torch.inference_mode()(lively_network("resnet18").disparity), []

    def compiled(images: Tensor) -> Tensor:
        seen.append(len(images))
        return network(images)

    padded, images = PaddedBatches(compiled), random_images(6)
    for count in (6, 5, 4, 3, 2, 1, 6):
        given = padded(images[:count])
        assert len(given) == count
        torch.testing.assert_close(given, network(images[:count]))
    assert seen == [6, 6, 6, 6, 2, 2, 6]


def test_a_batch_that_does_not_fit_into_memory_any_more_is_not_filled_up_again():
    fits = [6]

    def compiled(images: Tensor) -> Tensor:
        if len(images) > fits[0]:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return images

    padded, images = PaddedBatches(compiled), random_images(6)
    padded(images)
    fits[0] = 3
    with pytest.raises(torch.cuda.OutOfMemoryError):
        padded(images)
    assert len(padded(images[:3])) == len(padded(images[3:])) == 3


@pytest.mark.parametrize(
    "backend", [pytest.param("ncnn", marks=needs_ncnn), pytest.param("openvino", marks=needs_openvino)]
)
def test_images_side_by_side_have_the_same_depth_on_any_number_of_threads(
    backend: str, monkeypatch: pytest.MonkeyPatch
):
    pictures, found = random_pictures(5), []
    for threads in (1, 4):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        engine = build_engine(lively_network("resnet18"), spec_of("resnet18"), "cpu", backend)
        one_by_one = torch.cat([engine.disparity(surround_of([picture])) for picture in pictures])
        found += [one_by_one, engine.disparity(surround_of(pictures)), engine.disparity(surround_of(pictures[:2]))]
    assert all(torch.equal(disparity, found[0][: len(disparity)]) for disparity in found)


@needs_ncnn
def test_ncnn_takes_images_whose_memory_is_not_contiguous(monkeypatch: pytest.MonkeyPatch):
    """Side by side, one image's memory, were it freed too early, would be taken for another's."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    engine = selection.checked_engine(lively_network("resnet18"), spec_of("resnet18"), CPU, "ncnn", "float32")
    images = torch.rand(8, 3, 2 * HEIGHT, 2 * WIDTH, generator=torch.Generator().manual_seed(1))
    rig = rig_of(images)
    expected = engine.disparity(rig)
    strided = images.contiguous(memory_format=torch.channels_last)[None]
    for _ in range(5):
        assert torch.equal(engine.disparity(rig._replace(images=strided)), expected)


@needs_ncnn
def test_a_layer_that_ncnn_was_not_taught_is_named():
    rewritten = RewrittenDepthNet(lively_network("resnet18"), transposed=False)
    rewritten.decoder.head.append(nn.GELU())
    with pytest.raises(EngineError, match=r"decoder\.head\.2 is a GELU, which is not known here"):
        ncnn_model(rewritten)


@pytest.mark.parametrize("encoder", KINDS)
def test_half_precision_keeps_depth_within_its_limit(encoder: str):
    network, spec = lively_network(encoder), spec_of(encoder)

    class OnCpu(TorchEngine):
        def __init__(self) -> None:
            self.name, self.device = "bfloat16", CPU
            self._run = MixedPrecision(RewrittenDepthNet(network), torch.bfloat16)

    assert 1e-4 < check_parity(OnCpu(), network, spec, "bfloat16") < 5e-2


@pytest.mark.skipif(not is_installed("onnxruntime"), reason="onnx or onnxruntime is not installed")
def test_an_exported_model_takes_any_number_and_size_of_pictures():
    import onnxruntime

    from cvcdepth_core.engines.onnx_engine import onnx_model

    network = lively_network("efficientnet_lite0")
    session = onnxruntime.InferenceSession(onnx_model(network, spec_of("efficientnet_lite0")))
    images = torch.rand(3, 3, 96, 160, generator=torch.Generator().manual_seed(1))
    (disparity,) = session.run(["disparity"], {"images": images.numpy()})
    with torch.inference_mode():
        np.testing.assert_allclose(disparity, network.disparity(images).numpy(), rtol=1e-4)


@needs_cuda
@pytest.mark.parametrize("precision", get_args(Precision))
@pytest.mark.parametrize("backend", ["torch", "torch_compiled"])
def test_cuda_engines_pass_the_parity_check(backend: str, precision: Precision):
    network = lively_network("resnet18").cuda()
    engine = build_engine(network, spec_of("resnet18"), "cuda", backend, precision)
    pictures = random_pictures(6)
    first = engine.disparity(surround_of(pictures))
    kept = first.clone()
    with ThreadPoolExecutor(1) as another_thread:
        again = another_thread.submit(engine.disparity, surround_of(pictures[::-1])).result()
    torch.testing.assert_close(again.flip(0), first, rtol=1e-2, atol=1e-3)
    assert torch.equal(first, kept)  # a CUDA graph's own memory would have changed


@needs_cuda
@pytest.mark.skipif(not is_installed("tensorrt"), reason="onnx or onnxruntime is not installed")
def test_tensorrt_wants_its_engine_built_first(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(EngineError, match=r"no engine of this network .* cvcdepth export --tensorrt"):
        build_engine(lively_network("resnet18"), spec_of("resnet18"), "cuda", "tensorrt")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, spec_of("resnet18"), lively_network("resnet18").state_dict())
    return path


@pytest.mark.skipif(not is_installed("onnxruntime"), reason="onnx or onnxruntime is not installed")
def test_export_writes_a_checked_model_and_how_its_output_becomes_metres(checkpoint: Path, capsys):
    assert main(["export", str(checkpoint), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["file"] == str(checkpoint.with_suffix(".onnx"))
    assert result["relative_depth_error"] < 1e-4
    assert checkpoint.with_suffix(".onnx").stat().st_size > 5e7
    described = json.loads(checkpoint.with_suffix(".json").read_text())
    assert (described["max_depth"], described["height"]) == (100.0, HEIGHT)
    disparity = 0.25
    fx = 200.0
    depth = eval(described["depth"].partition("=")[2], {}, described | {"fx": fx, "disparity": disparity})
    expected = disparity_to_depth(torch.full((1, 1, 1), disparity), torch.tensor(fx), 0.5, 100.0)
    assert depth == pytest.approx(expected.item())
    assert main(["export", str(checkpoint)]) == 1
    checkpoint.with_suffix(".onnx").unlink()
    assert main(["export", str(checkpoint)]) == 1  # the description is there
    assert main(["export", str(checkpoint), "-o", str(checkpoint.with_name("other.json"))]) == 1
    assert "model.onnx: exists already; --force overwrites it" in capsys.readouterr().err


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_a_tensorrt_engine_needs_a_gpu(checkpoint: Path, capsys):
    assert main(["export", str(checkpoint), "--tensorrt"]) == 1
    assert "device: 'cuda' is not available" in capsys.readouterr().err
