# SPDX-License-Identifier: Apache-2.0
"""Surround pictures in, metric depth out: the one estimator behind the node, the bag tool and the evaluation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.engines import build_engine
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.model_choices import FlipFusion, Precision
from cvcdepth_core.networks import DepthNetwork, build_depth_network, disparity_to_depth
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.networks.mirroring import fuse_with_mirrored, mirrored_pictures
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.volume import refuse_cameras_outside
from cvcdepth_core.rig.ground import refuse_unlikely_ground
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.sky import beyond_measure, sky_in_pictures
from cvcdepth_core.surround_depth import SurroundDepth, SurroundPictures


class PictureSize(Protocol):
    """The size of the pictures that a predictor takes."""

    @property
    def height(self) -> int:
        """Rows."""

    @property
    def width(self) -> int:
        """Columns."""


class DepthPredictor(Protocol):
    """Whatever gives depth for pictures: the network, or a reference that it must beat."""

    @property
    def spec(self) -> PictureSize:
        """The pictures it takes."""

    @property
    def model_id(self) -> str:
        """What reports call it."""

    @property
    def independent(self) -> bool:
        """Whether a camera's depth depends on no other camera: then pictures that nobody wants may be left out."""

    def estimate(self, surround: SurroundPictures) -> NDArray[np.float32]:
        """Return depth [N, H, W] in metres of one set; absent cameras' means nothing."""


class PredictedDepth(NamedTuple):
    """What a network says of the pictures of one set, [N, H, W] each; absent cameras' means nothing."""

    depth: NDArray[np.float32]
    """Metres along the optical axis."""
    sky: NDArray[np.float32] | None = None
    """Probability that the pixel shows the sky, whose depth is the farthest there is; None where it is not told."""
    log_uncertainty: NDArray[np.float32] | None = None
    """Natural logarithm of the error of log depth that is to be expected; None where it is not told."""


class DepthEstimator:
    """A depth network, run by one of the engines."""

    def __init__(
        self,
        network: DepthNetwork,
        spec: DepthModelSpec,
        weights_id: str,
        device: str = "auto",
        backend: str = "auto",
        precision: Precision = "float32",
        cpu_fallback: bool = False,
        flip_fusion: FlipFusion = "none",
    ) -> None:
        """`weights_id` is what reports call the weights; for the rest, and the errors raised, see `build_engine`.

        With `flip_fusion` the network sees every set twice, the second time mirrored, and both depths are fused.
        """
        self.spec = spec
        self.weights_id = weights_id
        self.flip_fusion = flip_fusion
        self._mirror_offset = network.mirror_offset
        self._engine = build_engine(network, spec, device, backend, precision, cpu_fallback)

    @classmethod
    def from_checkpoint(cls, path: Path, device: str = "auto", **engine: Any) -> "DepthEstimator":
        """Load a checkpoint file; CheckpointError names what is wrong with it. `engine` is as for the constructor."""
        checkpoint = load_checkpoint(path)
        weights_id = f"{checkpoint.path.name} sha256:{checkpoint.sha256[:12]}"
        return cls(checkpoint.build_depth_net(), checkpoint.spec, weights_id, device, **engine)

    @classmethod
    def untrained(cls, spec: DepthModelSpec, device: str = "auto", seed: int = 0, **engine: Any) -> "DepthEstimator":
        """Build a network with random weights: its depth has the right form and no meaning."""
        return cls(
            untrained_network(spec, seed),
            spec,
            f"untrained {spec.kind} (random weights, seed {seed})",
            device,
            **engine,
        )

    @property
    def model_id(self) -> str:
        """What reports call the weights and what runs them."""
        fused = "" if self.flip_fusion == "none" else f", flip fusion of {self.flip_fusion.replace('_', ' ')}"
        return f"{self.weights_id} with {self._engine.name}{fused}"

    @property
    def device(self) -> torch.device:
        """Where inference runs."""
        return self._engine.device

    @property
    def independent(self) -> bool:
        """As the network declares it."""
        return self._engine.independent

    def estimate(self, surround: SurroundPictures) -> NDArray[np.float32]:
        """Return depth [N, H, W] in metres of one set; see `details`."""
        return self.details(surround).depth

    def details(self, surround: SurroundPictures) -> PredictedDepth:
        """Return depth of one set and what else the network says.

        On a CPU an independent camera's depth does not depend on the others to the last bit. Raises EngineError when
        the device fails or has too little memory.
        """
        with torch.inference_mode():
            found = self._predicted(surround)
            if self.flip_fusion != "none":
                mirrored = mirrored_pictures(surround, self._mirror_offset)
                found = found.fused(self._predicted(mirrored), self.flip_fusion)
        return found.arrays()

    def sky(self, surround: SurroundPictures, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return where a set shows the sky [N, H, W], by its `depth` where the network knows the sky, else by looks."""
        if self.spec.tells_sky:
            return beyond_measure(depth, surround.fx, self.spec.max_depth, self.spec.focal_scale)
        return sky_in_pictures(surround, depth)

    def _predicted(self, surround: SurroundPictures) -> "_Predicted":
        outputs = self._engine.details(surround)
        depth = disparity_to_depth(
            outputs.disparity,
            torch.as_tensor(surround.fx, dtype=torch.float32),
            self.spec.min_depth,
            self.spec.max_depth,
            self.spec.focal_scale,
        )
        sky = None if outputs.sky is None else torch.sigmoid(outputs.sky)
        return _Predicted(depth, sky, outputs.log_uncertainty)


class _Predicted(NamedTuple):
    """As `PredictedDepth`, [N, 1, H, W] each."""

    depth: torch.Tensor
    sky: torch.Tensor | None
    log_uncertainty: torch.Tensor | None

    def fused(self, mirrored: "_Predicted", fusion: FlipFusion) -> "_Predicted":
        """Return both passes as one; beside depth, by the mean of both."""
        depth = fuse_with_mirrored(self.depth, mirrored.depth, fusion)
        others = (
            None if one is None or other is None else fuse_with_mirrored(one, other, "depth")
            for one, other in zip(self[1:], mirrored[1:], strict=True)
        )
        return _Predicted(depth, *others)

    def arrays(self) -> PredictedDepth:
        """Return them without the channel."""
        sky, log_uncertainty = (None if part is None else part[:, 0].numpy() for part in self[1:])
        return PredictedDepth(self.depth[:, 0].numpy(), sky, log_uncertainty)


def is_told_its_rig(predictor: DepthPredictor) -> bool:
    """Say whether its depth depends on where the rig's cameras are and look, and how high above the ground."""
    return isinstance(predictor, DepthEstimator) and predictor.spec.is_told_its_rig


def untrained_network(spec: DepthModelSpec, seed: int = 0) -> DepthNetwork:
    """Return a depth network whose weights are random and always the same."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build_depth_network(spec)


class SurroundDepthEstimator:
    """A depth predictor for one rig: rectifies each camera's picture and estimates depth for a whole set.

    `preprocessor` holds what belongs to the rig: intrinsics and validity of the network's pictures.
    """

    def __init__(self, rig: Rig, estimator: DepthPredictor, known: "SurroundDepthEstimator | None" = None) -> None:
        """Prepare the maps; those of `known` are taken over for the cameras that have not changed.

        RigError names the camera where the network is told the rig, and the rig cannot be right about the ground, or
        where the network's volume does not contain it.
        """
        if is_told_its_rig(estimator):
            refuse_unlikely_ground(rig)
        if isinstance(estimator, DepthEstimator) and estimator.spec.volume is not None:
            refuse_cameras_outside(estimator.spec.volume, rig.poses_above_ground, rig.names)
        self.rig = rig
        self.estimator = estimator
        self.preprocessor: SurroundPreprocessor = SurroundPreprocessor(
            rig, estimator.spec.height, estimator.spec.width, known.preprocessor if known else None
        )
        self._base_T_camera = rig.poses_above_ground

    def warm_up(self) -> None:
        """Estimate black pictures, so that what an engine does but once for so many cameras is done."""
        self.estimate(list(np.zeros((*self.preprocessor.valid.shape, 3), np.uint8)))

    def estimate(self, rectified: Sequence[Picture | None]) -> SurroundDepth:
        """Estimate one set from its rectified pictures [H, W, 3] in the rig's order, None where none is wanted or had.

        What is not given is absent for the predictor.
        """
        pictures = self._surround_pictures(rectified)
        depth = np.full(pictures.valid.shape, np.nan, dtype=np.float32)
        if pictures.present.any():
            known = pictures.valid & pictures.present[:, None, None]
            np.copyto(depth, self.estimator.estimate(pictures), where=known)
        sky = self.estimator.sky(pictures, depth) if isinstance(self.estimator, DepthEstimator) else None
        return SurroundDepth(depth, pictures.pictures, pictures.intrinsics, pictures.present, sky=sky)

    def _surround_pictures(self, rectified: Sequence[Picture | None]) -> SurroundPictures:
        pictures = np.zeros((*self.preprocessor.valid.shape, 3), dtype=np.uint8)
        for place, picture in zip(pictures, rectified, strict=True):
            if picture is not None:
                place[:] = picture
        return SurroundPictures(
            pictures=pictures,
            present=np.array([picture is not None for picture in rectified]),
            intrinsics=self.preprocessor.intrinsics,
            base_T_camera=self._base_T_camera,
            valid=self.preprocessor.valid,
        )
