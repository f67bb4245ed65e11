# SPDX-License-Identifier: Apache-2.0
"""The pose network of a checkpoint by itself, and how far its answers are from recorded motion."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks import PoseNet, RigImages
from cvcdepth_core.networks.checkpoint import Checkpoint, load_network_state
from cvcdepth_core.networks.registry import SURROUNDDEPTH
from cvcdepth_core.networks.vfdepth import VolumePoseNet
from cvcdepth_core.networks.volume import VolumeSpec
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.training.model import PoseMethod
from cvcdepth_core.training.motion import motion_to_context

TRUSTED_RATIOS = (0.8, 1.25)
"""Predicted over recorded way, within which a pose network is taken for right."""

_LEAST_WAY = 0.1  # metres: shorter ones are told by noise


class PoseAnswers:
    """A trained pose network, asked for the motion between two sets of pictures."""

    def __init__(self, network: PoseNet | VolumePoseNet, method: PoseMethod) -> None:
        self._network = network.eval()
        self._method = method

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> PoseAnswers | None:
        """Return the checkpoint's pose network; None where it has none.

        What its configuration says decides the encoder and which pictures it sees; without one, the depth network's
        encoder and the anchor's pictures. CheckpointError names weights that do not fit.
        """
        if not checkpoint.pose_net:
            return None
        encoder, method = _described(checkpoint)
        network: PoseNet | VolumePoseNet = PoseNet(encoder)
        if method == "volume":
            network = VolumePoseNet(encoder, checkpoint.spec.volume or VolumeSpec())
        load_network_state(network, checkpoint.pose_net, origin=f"{checkpoint.path}: pose network")
        return cls(network, method)

    def later_T_earlier(  # noqa: N802
        self,
        earlier: NDArray[np.uint8],
        later: NDArray[np.uint8],
        base_T_camera: NDArray[np.float64],
        anchor: int,
        intrinsics: NDArray[np.float64],
    ) -> Pose:
        """Return the anchor camera's motion [4, 4] between two sets of pictures [N, H, W, 3] of N cameras.

        Their poses have the ground at z = 0, `intrinsics` [N, 3, 3] are in pixels of the pictures.
        """
        seen = [anchor] if self._method in ("front", "per_camera") else list(range(len(earlier)))
        views = [torch.from_numpy(frame[seen]).permute(0, 3, 1, 2).float()[None] / 255 for frame in (earlier, later)]
        with torch.inference_mode():
            if isinstance(self._network, VolumePoseNet):
                axis_angle, translation = self._network(_rig_of(views[0], base_T_camera, intrinsics), views[1])
            else:
                axis_angle, translation = self._network(*views)
            motion: Pose = motion_to_context(axis_angle, translation, backward=False)[0].double().numpy()
        if self._method != "joint":
            return motion
        seen_from_anchor: Pose = inverse(base_T_camera[anchor]) @ motion @ base_T_camera[anchor]
        return seen_from_anchor


def _rig_of(images: Tensor, base_T_camera: NDArray[np.float64], intrinsics: NDArray[np.float64]) -> RigImages:
    """Return images [1, N, 3, H, W] with their cameras, all of whose pixels show the scene."""
    return RigImages(
        images=images,
        intrinsics=torch.from_numpy(intrinsics).float()[None],
        base_T_camera=torch.from_numpy(base_T_camera).float()[None],
        present=torch.ones(images.shape[:2], dtype=torch.bool),
        masks=torch.ones_like(images[:, :, :1]),
    )


class MotionError(NamedTuple):
    """How one answer differs from the recorded motion."""

    predicted: float
    """Metres, along the recorded direction."""
    recorded: float
    """Metres."""
    degrees: float
    """Of rotation between the two."""


def motion_error(predicted: Pose, recorded: Pose) -> MotionError | None:
    """Compare two motions [4, 4]; None where the recorded one is too short to be a measure."""
    way = float(np.linalg.norm(recorded[:3, 3]))
    if way < _LEAST_WAY:
        return None
    cosine = (np.trace(recorded[:3, :3].T @ predicted[:3, :3]) - 1) / 2
    along = float(predicted[:3, 3] @ recorded[:3, 3]) / way
    return MotionError(along, way, float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))


class PoseScore(NamedTuple):
    """A pose network's answers beside recorded motion."""

    steps: int
    """Pairs of sets."""
    predicted_metres: float
    """Along the recorded direction, all steps together."""
    recorded_metres: float
    """All steps together."""
    degrees: float
    """Mean error of rotation."""

    @property
    def ratio(self) -> float:
        """The predicted share of the recorded way."""
        return self.predicted_metres / self.recorded_metres

    @property
    def is_trusted(self) -> bool:
        """Whether the share lies within `TRUSTED_RATIOS`."""
        least, greatest = TRUSTED_RATIOS
        return least <= self.ratio <= greatest

    def describe(self) -> str:
        """Return the score in words."""
        return f"{self.ratio:.2f} of the recorded way in {self.steps} steps, {self.degrees:.2f} degrees off"

    @classmethod
    def joined(cls, scores: Sequence[PoseScore]) -> PoseScore | None:
        """Return the score of all of them together; None of none."""
        if not scores:
            return None
        steps, predicted, recorded, _ = (sum(column) for column in zip(*scores, strict=True))
        return cls(int(steps), predicted, recorded, sum(one.degrees * one.steps for one in scores) / steps)

    @classmethod
    def of(cls, errors: Sequence[MotionError]) -> PoseScore | None:
        """Return the score of some answers; None of none."""
        return cls.joined([cls(1, *error) for error in errors])


def pose_score_to_json(score: PoseScore | None) -> dict[str, float | None]:
    """Return a score for JSON: no steps and null where nothing could be compared."""
    if score is None:
        return {"steps": 0, **dict.fromkeys([*PoseScore._fields[1:], "ratio"])}
    return {**score._asdict(), "ratio": score.ratio}


def _method_of(checkpoint: Checkpoint) -> str:
    """Return what a checkpoint that does not tell its configuration must be: released weights have none."""
    if checkpoint.spec.network == SURROUNDDEPTH:
        return "joint"
    return "volume" if any(key.startswith("birds_eye.") for key in checkpoint.pose_net) else "front"


def _described(checkpoint: Checkpoint) -> tuple[str, PoseMethod]:
    """Return encoder and method."""
    try:
        pose = json.loads(checkpoint.metadata.get("config", "{}")).get("pose", {})
        encoder, method = pose.get("encoder", checkpoint.spec.encoder), pose.get("method", _method_of(checkpoint))
    except (ValueError, AttributeError) as error:
        raise CheckpointError(f"{checkpoint.path}: its metadata `config` is no configuration: {error}") from error
    if method not in get_args(PoseMethod):
        raise CheckpointError(f"{checkpoint.path}: its pose.method is {method!r}, not one of {get_args(PoseMethod)}")
    return encoder, method
