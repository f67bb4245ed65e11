# SPDX-License-Identifier: Apache-2.0
"""Surround pictures in, metric depth out: the one estimator behind the node, the bag tool and the evaluation."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.checkpoint import DepthModelSpec, load_checkpoint
from cvcdepth_core.errors import ConfigError
from cvcdepth_core.images import Picture
from cvcdepth_core.networks import DepthNet, disparity_to_depth
from cvcdepth_core.preprocess import SurroundPreprocessor, to_tensor
from cvcdepth_core.rig import Rig


@dataclass(frozen=True, eq=False)
class SurroundDepth:
    """What was estimated for one surround set; every array holds the cameras in the rig's order."""

    depth: NDArray[np.float32]
    """[N, H, W] metres along each camera's optical axis, NaN where unknown (REP 118)."""
    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB, rectified: pixel by pixel what `depth` describes."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] of those pictures, pixel centres at the integers."""
    present: NDArray[np.bool_]
    """[N] which cameras gave a picture; the others' depth is NaN and their picture black."""


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

    def estimate(self, pictures: Sequence[Picture], fx: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return depth [N, H, W] in metres of RGB pictures [H, W, 3]; `fx` [N] is in pixels of those pictures."""


class DepthEstimator:
    """A depth network on a device."""

    def __init__(self, network: DepthNet, spec: DepthModelSpec, model_id: str, device: str = "auto") -> None:
        """`model_id` is what reports call the weights; ConfigError when `device` does not exist here."""
        self.spec = spec
        self.model_id = model_id
        self.device = resolve_device(device)
        self._network = network.eval().to(self.device)

    @classmethod
    def from_checkpoint(cls, path: Path, device: str = "auto") -> "DepthEstimator":
        """Load a checkpoint file; CheckpointError names what is wrong with it."""
        checkpoint = load_checkpoint(path)
        model_id = f"{checkpoint.path.name} sha256:{checkpoint.sha256[:12]}"
        return cls(checkpoint.build_depth_net(), checkpoint.spec, model_id, device)

    @classmethod
    def untrained(cls, spec: DepthModelSpec, device: str = "auto", seed: int = 0) -> "DepthEstimator":
        """Build a network with random weights: its depth has the right form and no meaning."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = DepthNet(spec.encoder)
        return cls(network, spec, f"untrained {spec.encoder} (random weights, seed {seed})", device)

    def estimate(self, pictures: Sequence[Picture], fx: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return depth [N, H, W] in metres of RGB pictures [H, W, 3]; `fx` [N] is in pixels of those pictures."""
        images = to_tensor(pictures, self.device)
        with torch.inference_mode():
            depth = disparity_to_depth(
                self._network(images),
                torch.as_tensor(fx, dtype=torch.float32, device=self.device),
                self.spec.min_depth,
                self.spec.max_depth,
                self.spec.focal_scale,
            )
        metres: NDArray[np.float32] = depth[:, 0].cpu().numpy()
        return metres


class SurroundDepthEstimator:
    """A depth predictor for one rig: rectifies each camera's picture and estimates depth for a whole set.

    `preprocessor` holds what belongs to the rig: intrinsics and validity of the network's pictures.
    """

    def __init__(self, rig: Rig, estimator: DepthPredictor, known: "SurroundDepthEstimator | None" = None) -> None:
        """`known` is an estimator whose maps are taken over for the cameras that have not changed."""
        self.rig = rig
        self.estimator = estimator
        self.preprocessor: SurroundPreprocessor = SurroundPreprocessor(
            rig, estimator.spec.height, estimator.spec.width, known.preprocessor if known else None
        )

    def estimate(self, rectified: Sequence[Picture | None]) -> SurroundDepth:
        """Estimate one set from its rectified pictures [H, W, 3] in the rig's order, None where none is wanted.

        The predictor gets only the pictures that are there.
        """
        cameras = [index for index, picture in enumerate(rectified) if picture is not None]
        pictures = [picture for picture in rectified if picture is not None]
        valid, intrinsics = self.preprocessor.valid, self.preprocessor.intrinsics
        surround = SurroundDepth(
            depth=np.full(valid.shape, np.nan, dtype=np.float32),
            pictures=np.zeros((*valid.shape, 3), dtype=np.uint8),
            intrinsics=intrinsics,
            present=np.isin(np.arange(len(valid)), cameras),
        )
        estimated = self.estimator.estimate(pictures, intrinsics[cameras, 0, 0]) if pictures else ()
        for index, picture, depth in zip(cameras, pictures, estimated, strict=True):
            np.copyto(surround.depth[index], depth, where=valid[index])
            surround.pictures[index] = picture
        return surround


def resolve_device(name: str) -> torch.device:
    """Return the device of that name, `auto` being CUDA where there is one; ConfigError when it is not there."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device: '{name}' is not available: {str(error).splitlines()[0]}") from error
    return device
