# SPDX-License-Identifier: Apache-2.0
"""The kinds of depth networks, and what describes one: the only place that knows their classes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
from cvcdepth_core.networks.depth import INPUT_STRIDE, MIN_INPUT_SIZE, DepthNet
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet
from cvcdepth_core.networks.rig_images import DepthNetwork

PER_CAMERA = "per_camera"
"""The published network, which looks at every camera on its own."""
RIG_CONDITIONED = "rig_conditioned"
"""The network that is told its rig: see `RigConditionedNet`."""


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
        return fields


def build_depth_network(spec: DepthModelSpec) -> DepthNetwork:
    """Return the network that `spec` describes, with random weights."""
    return NETWORKS[spec.network](spec)


NETWORKS: dict[str, Callable[[DepthModelSpec], DepthNetwork]] = {
    PER_CAMERA: lambda spec: DepthNet(spec.encoder),
    RIG_CONDITIONED: lambda spec: RigConditionedNet(spec.min_depth, spec.max_depth, spec.focal_scale),
}
"""Each kind's name in checkpoints and training files, and what builds one with random weights."""
