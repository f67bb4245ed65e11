# SPDX-License-Identifier: Apache-2.0
"""ONNX: export of the rewritten network, and ONNX Runtime on CPU, CUDA and TensorRT."""

from __future__ import annotations

import copy
import hashlib
import inspect
import io
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from cvcdepth_core.engines.conditioning import KeptForRig, conditioning_of
from cvcdepth_core.engines.engine import DeviceMemoryError, best_chunk, image_by_image
from cvcdepth_core.engines.example_rigs import ring_of_cameras
from cvcdepth_core.engines.rewriting import RewrittenDepthNet
from cvcdepth_core.engines.rewriting_conditioned import RewrittenRigConditionedNet, ToldConstants
from cvcdepth_core.errors import EngineError
from cvcdepth_core.model_choices import Precision
from cvcdepth_core.networks import ConditionedNetwork, DepthNet, DepthNetwork, DepthOutputs, RigImages
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet

INPUT, OUTPUT = "images", "disparity"
CONDITIONING = "conditioning"
DETAILS = DepthOutputs._fields
"""The outputs of a network that is told its rig, `disparity` the first."""
MOST_CAMERAS = 12
"""Images that a TensorRT engine takes at once."""

_OPSET = 17
_USUAL_CAMERAS = 6


def onnx_model(network: DepthNetwork, spec: DepthModelSpec) -> bytes:
    """Return the network as an ONNX model.

    The published network becomes `images` [B, 3, H, W] in [0, 1] to `disparity` [B, 1, H, W], of any B, H and W; H and
    W are multiples of 32, those of `spec` are what the network was trained for. A network that is told its rig takes
    `conditioning` [B, C, H, W] too, which is made of each camera's calibration once, and gives all of `DepthOutputs` by
    their names. Any other one takes the fields of `RigImages` by their names and gives `disparity` [1, N, 1, H, W], of
    any N, at the size of `spec`.
    """
    if isinstance(network, DepthNet):
        images = {INPUT: torch.zeros(1, 3, spec.height, spec.width)}
        return _exported(RewrittenDepthNet(network), images, {0: "cameras", 2: "height", 3: "width"})
    rig = ring_of_cameras(spec.height, spec.width)
    if isinstance(network, ConditionedNetwork):
        alone = rig.of_cameras([0])
        inputs = {INPUT: alone.images[0], CONDITIONING: network.conditioning(alone)[0]}
        axes = {0: "cameras", 2: "height", 3: "width"}
        return _exported(_OnConditioning(copy.deepcopy(network).eval()), inputs, axes, DETAILS)
    return _exported(_OnTensors(copy.deepcopy(network).eval()), rig._asdict(), {1: "cameras"})


def rewritten_onnx_model(network: RigConditionedNet, spec: DepthModelSpec) -> bytes:
    """Return, as an ONNX model, what `RewrittenRigConditionedNet` takes by name to its head, which is the output."""
    rig = ring_of_cameras(spec.height, spec.width).of_cameras([0])
    *told, _ = ToldConstants(network)(network.conditioning(rig)[0])
    inputs = {INPUT: rig.images[0], **dict(zip(ToldConstants.names, told, strict=True))}
    return _exported(RewrittenRigConditionedNet(network), inputs, [0, 2, 3])


class _OnTensors(nn.Module):
    """A network of the rig as the exporter wants it: tensors in, a tensor out."""

    def __init__(self, network: DepthNetwork) -> None:
        super().__init__()
        self._network = network

    def forward(self, *parts: Tensor) -> Tensor:
        disparity: Tensor = self._network(RigImages(*parts))
        return disparity


class _OnConditioning(nn.Module):
    """A network that is told its rig, of images and conditioning."""

    def __init__(self, network: ConditionedNetwork) -> None:
        super().__init__()
        self._network = network

    def forward(self, images: Tensor, conditioning: Tensor) -> DepthOutputs:
        return self._network.outputs(images, conditioning)


def _exported(
    network: nn.Module,
    inputs: dict[str, Tensor],
    axes: dict[int, str] | list[int],
    outputs: Sequence[str] = (OUTPUT,),
) -> bytes:
    """Export for inputs of the examples' sizes, but for `axes`, which may have any; those of a name have the same."""
    content = io.BytesIO()
    dynamic: dict[str, Any] = dict.fromkeys((*inputs, *outputs), axes)
    # The newer exporter needs two more packages and gives the same graph; torch before 2.5 does not know the word.
    older = {"dynamo": False} if "dynamo" in inspect.signature(torch.onnx.export).parameters else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.float().cpu(),
            tuple(inputs.values()),
            content,  # type: ignore[arg-type]
            opset_version=_OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes=dynamic,
            **older,  # type: ignore[arg-type]
        )
    return content.getvalue()


class OnnxRuntimeEngine:
    """The exported network in ONNX Runtime; on a CPU on as many threads as torch has when it is built."""

    def __init__(self, network: DepthNetwork, spec: DepthModelSpec, device: torch.device) -> None:
        """EngineError when this ONNX Runtime cannot use `device`."""
        import onnxruntime

        provider = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}[device.type]
        options = {"device_id": device.index or 0} if device.type == "cuda" else {}
        self.device = device
        self.chunk = best_chunk(network, device)
        self.name = f"onnxruntime {onnxruntime.__version__} {device.type} float32"
        self.model = onnx_model(network, spec)
        self._session = _session(self.model, [(provider, options)])
        self._takes_images = isinstance(network, DepthNet)
        self._told = KeptForRig(conditioning_of(network)) if isinstance(network, ConditionedNetwork) else None
        self._inputs = [given.name for given in self._session.get_inputs()]

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return self.details(rig).disparity

    def details(self, rig: RigImages) -> DepthOutputs:
        """See `DetailedEngine`."""
        if self._takes_images:
            return DepthOutputs(image_by_image(lambda images: _run(self._session, {INPUT: images}), rig))
        if self._told is not None:
            (told,) = self._told(rig)
            found = _run_all(self._session, {INPUT: rig.images.flatten(0, 1), CONDITIONING: told}, DETAILS)
            return DepthOutputs(*(part.view(*rig.images.shape[:2], *part.shape[1:]) for part in found))
        return DepthOutputs(_run(self._session, {name: getattr(rig, name) for name in self._inputs}))


class TensorRtEngine:
    """The exported network in ONNX Runtime's TensorRT provider, from an engine that was built before."""

    def __init__(
        self,
        network: DepthNet,
        spec: DepthModelSpec,
        device: torch.device,
        precision: Precision,
        build: bool = False,
    ) -> None:
        """EngineError when the engine was not built (`build` does it, which takes minutes)."""
        import onnxruntime

        self.device = device
        self.chunk = best_chunk(network, device)
        self.name = f"tensorrt of onnxruntime {onnxruntime.__version__} {precision}"
        folder = engine_folder(network, spec, device, precision)
        if not build and not any(folder.glob("*.engine")):
            raise EngineError(
                f"{self.name}: no engine of this network for {torch.cuda.get_device_name(device)} in {folder}; "
                "build it, which takes minutes, with: cvcdepth export --tensorrt"
            )
        folder.mkdir(parents=True, exist_ok=True)
        options = _tensorrt_options(spec, device, precision, folder)
        cuda = ("CUDAExecutionProvider", {"device_id": device.index or 0})  # for what TensorRT does not know
        self._session = _session(onnx_model(network, spec), [("TensorrtExecutionProvider", options), cuda])

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return image_by_image(self._each, rig)

    def _each(self, images: Tensor) -> Tensor:
        return torch.cat([_run(self._session, {INPUT: part}) for part in images.split(MOST_CAMERAS)])  # type: ignore[no-untyped-call]


def engine_folder(network: DepthNet, spec: DepthModelSpec, device: torch.device, precision: Precision) -> Path:
    """Name the folder of a built TensorRT engine, by GPU, versions, weights, size and precision."""
    import onnxruntime

    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cvcdepth" / "tensorrt"
    gpu = torch.cuda.get_device_name(device).replace(" ", "-")
    capability = ".".join(map(str, torch.cuda.get_device_capability(device)))
    versions = f"onnxruntime-{onnxruntime.__version__}_cuda-{torch.version.cuda}"
    weights = f"{spec.encoder}-{spec.height}x{spec.width}-{weights_hash(network)[:16]}"
    return root / f"{gpu}_{capability}_{versions}" / f"{weights}_{precision}"


def weights_hash(network: DepthNet) -> str:
    """Return the SHA-256 of all names and values of the network's state."""
    digest = hashlib.sha256()
    for name, value in network.state_dict().items():
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _tensorrt_options(spec: DepthModelSpec, device: torch.device, precision: Precision, folder: Path) -> dict[str, Any]:
    shapes = {"min": 1, "opt": _USUAL_CAMERAS, "max": MOST_CAMERAS}
    return {
        "device_id": device.index or 0,
        "trt_fp16_enable": precision == "float16",
        "trt_bf16_enable": precision == "bfloat16",
        "trt_engine_cache_enable": True,
        "trt_engine_cache_path": str(folder),
        "trt_timing_cache_enable": True,
        "trt_timing_cache_path": str(folder),
        **{f"trt_profile_{key}_shapes": f"{INPUT}:{n}x3x{spec.height}x{spec.width}" for key, n in shapes.items()},
    }


def _session(model: bytes, providers: list[tuple[str, dict[str, Any]]]) -> Any:
    import onnxruntime

    wanted = providers[0][0]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # other threads need the cores
    try:
        session = onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # its exceptions have no common base
        raise EngineError(f"onnxruntime {onnxruntime.__version__}: {wanted}: {error}") from error
    if wanted not in session.get_providers():  # it falls back to the CPU with a mere warning
        raise EngineError(
            f"onnxruntime {onnxruntime.__version__}: {wanted} is not available, found {session.get_providers()}"
        )
    return session


def _run(session: Any, inputs: Mapping[str, Tensor]) -> Tensor:
    (disparity,) = _run_all(session, inputs, [OUTPUT])
    return disparity


def _run_all(session: Any, inputs: Mapping[str, Tensor], outputs: Sequence[str]) -> list[Tensor]:
    try:
        found = session.run(list(outputs), {name: value.cpu().numpy() for name, value in inputs.items()})
    except Exception as error:
        if "memory" in str(error).lower() or "alloc" in str(error).lower():
            raise DeviceMemoryError(str(error)) from error
        raise EngineError(f"onnxruntime: inference failed: {error}") from error
    return [torch.from_numpy(part).to(next(iter(inputs.values())).device) for part in found]
