# SPDX-License-Identifier: Apache-2.0
"""The kinds of depth networks, and what describes one: the only place that knows their classes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from cvcdepth_core.model_choices import ENCODERS
from cvcdepth_core.networks.cross_view import CrossViewDepthNet, CrossViewSpec
from cvcdepth_core.networks.depth import INPUT_STRIDE, MIN_INPUT_SIZE, DepthNet
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet
from cvcdepth_core.networks.rig_images import DepthNetwork
from cvcdepth_core.networks.vfdepth import DEPTH_NAMES, POSE_NAMES, CorrectedFusedDepthNet, FusedDepthNet
from cvcdepth_core.networks.volume import VolumeSpec

PER_CAMERA = "per_camera"
"""The published network, which looks at every camera on its own."""
RIG_CONDITIONED = "rig_conditioned"
"""The network that is told its rig: see `RigConditionedNet`."""
VFDEPTH = "vfdepth"
"""The network that fuses its cameras in a volume: see `FusedDepthNet`."""
SURROUNDDEPTH = "surrounddepth"
"""The network whose cameras look at each other's features: see `CrossViewDepthNet`."""


class DepthModelSpec(BaseModel):
    """What a depth network was built and trained for; it travels with the weights."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    network: str = PER_CAMERA
    """Which network, one of `NETWORKS`; only written where it is not the published one."""
    encoder: str = "resnet18"
    """One of `ENCODERS`."""
    height: int = Field(ge=MIN_INPUT_SIZE, multiple_of=INPUT_STRIDE)
    """Rows of the network input, pixels."""
    width: int = Field(ge=MIN_INPUT_SIZE, multiple_of=INPUT_STRIDE)
    """Columns of the network input, pixels."""
    min_depth: float = Field(gt=0, allow_inf_nan=False)
    """Metres at disparity 1 for a camera with fx = focal_scale."""
    max_depth: float = Field(gt=0, allow_inf_nan=False)
    """Metres at disparity 0 for such a camera."""
    focal_scale: float = Field(default=300.0, gt=0, allow_inf_nan=False)
    """Focal length in pixels (at network resolution) for which the depth range is meant."""
    volume: VolumeSpec | None = None
    """For `network: vfdepth`: the volume that the cameras are fused in."""
    cross_view: CrossViewSpec | None = None
    """For `network: surrounddepth`: its transformers."""

    @property
    def kind(self) -> str:
        """What messages call the network: its encoder, after its name where it is not the published one."""
        return self.encoder if self.network == PER_CAMERA else f"{self.network}, {self.encoder}"

    @property
    def is_told_its_rig(self) -> bool:
        """Whether the network is told where its cameras are above the ground; rigs that have that wrong are refused."""
        return self.network == RIG_CONDITIONED

    @property
    def tells_sky(self) -> bool:
        """Whether the network knows the sky: then its depth there is the farthest that it can say."""
        return self.network == RIG_CONDITIONED

    @field_validator("network")
    @classmethod
    def _network_is_known(cls, network: str) -> str:
        if network not in NETWORKS:
            raise ValueError(f"expected one of {', '.join(NETWORKS)}")
        return network

    @field_validator("encoder")
    @classmethod
    def _encoder_is_known(cls, encoder: str) -> str:
        if encoder not in ENCODERS:
            raise ValueError(f"expected one of {', '.join(ENCODERS)}")
        return encoder

    @model_validator(mode="before")
    @classmethod
    def _part_of_the_network_is_the_usual_one(cls, fields: Any) -> Any:
        if not isinstance(fields, dict):
            return fields
        usual: dict[str, dict[str, BaseModel]] = {
            VFDEPTH: {"volume": VolumeSpec()},
            SURROUNDDEPTH: {"cross_view": CrossViewSpec()},
        }
        missing = usual.get(str(fields.get("network")), {})
        return fields | {name: part for name, part in missing.items() if fields.get(name) is None}

    @model_validator(mode="after")
    def _parts_are_the_networks(self) -> DepthModelSpec:
        for name, part, owner in (("volume", self.volume, VFDEPTH), ("cross_view", self.cross_view, SURROUNDDEPTH)):
            if part is not None and self.network != owner:
                raise ValueError(f"{name} is given, but the network {self.network} has none: expected network {owner}")
        return self

    @model_validator(mode="after")
    def _encoder_is_the_networks(self) -> DepthModelSpec:
        if self.is_told_its_rig and self.encoder != RigConditionedNet.ENCODER:
            raise ValueError(
                f"encoder is {self.encoder}, but the network {RIG_CONDITIONED} has {RigConditionedNet.ENCODER}"
            )
        return self

    @model_validator(mode="after")
    def _depth_range_is_ordered(self) -> DepthModelSpec:
        if self.min_depth >= self.max_depth:
            raise ValueError(f"min_depth {self.min_depth} must be below max_depth {self.max_depth}")
        return self

    @model_serializer(mode="wrap")
    def _without_the_usual_network(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Checkpoints and run folders from before there was a choice stay what they are, to the byte.
        fields: dict[str, Any] = serialise(self)
        if fields.get("network") == PER_CAMERA:
            del fields["network"]
        for name in ("volume", "cross_view"):
            if fields.get(name) is None:
                fields.pop(name, None)
        return fields


def _fused(spec: DepthModelSpec) -> FusedDepthNet:
    volume = spec.volume or VolumeSpec()
    return (CorrectedFusedDepthNet if volume.corrected else FusedDepthNet)(spec.encoder, volume)


class NetworkDescription(NamedTuple):
    """What can be said of a kind of network without weights."""

    name: str
    encoder: str
    """With which it is described."""
    parameters: int
    independent: bool
    """See `DepthNetwork`."""
    engines: tuple[str, ...]
    summary: str
    """One line."""


def describe_networks() -> list[NetworkDescription]:
    """Return every kind, with the encoder that it is usually built on and its published widths."""
    return [_described(name) for name in NETWORKS]


def _described(name: str) -> NetworkDescription:
    encoder = RigConditionedNet.ENCODER if name == RIG_CONDITIONED else "resnet18"
    with torch.device("meta"):
        network = build_depth_network(
            DepthModelSpec(network=name, encoder=encoder, height=384, width=640, min_depth=0.5, max_depth=200.0)
        )
    parameters = sum(parameter.numel() for parameter in network.parameters())
    summary = str(type(network).__doc__).splitlines()[0]
    return NetworkDescription(name, encoder, parameters, network.independent, network.engines, summary)


def build_depth_network(spec: DepthModelSpec) -> DepthNetwork:
    """Return the network that `spec` describes, with random weights."""
    return NETWORKS[spec.network](spec)


NETWORKS: dict[str, Callable[[DepthModelSpec], DepthNetwork]] = {
    PER_CAMERA: lambda spec: DepthNet(spec.encoder),
    RIG_CONDITIONED: lambda spec: RigConditionedNet(spec.min_depth, spec.max_depth, spec.focal_scale),
    VFDEPTH: _fused,
    SURROUNDDEPTH: lambda spec: CrossViewDepthNet(spec.encoder, spec.cross_view or CrossViewSpec()),
}
"""Each kind's name in checkpoints and training files, and what builds one with random weights."""

RELEASED_NAMES: dict[str, tuple[Mapping[str, str], Mapping[str, str]]] = {VFDEPTH: (DEPTH_NAMES, POSE_NAMES)}
"""How names begin in the released depth and pose network, and in ours, of kinds whose names differ."""
