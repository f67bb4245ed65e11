# SPDX-License-Identifier: Apache-2.0
"""What can be set for the live node and for recordings alike: the network, the matching, the outputs. No ROS here.

The node declares these fields as parameters, the bag tool as options; each field's docstring is its description there.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from cvcdepth_core.errors import ConfigError, first_validation_message
from cvcdepth_core.model_choices import DEFAULT, NOTICE, Backend, FlipFusion, Precision, checkpoint_path

if TYPE_CHECKING:
    from cvcdepth_core.estimator import DepthEstimator
    from cvcdepth_core.networks import DepthNetwork
    from cvcdepth_core.networks.registry import DepthModelSpec
    from cvcdepth_core.obstacles.scan import ScanLimits
    from cvcdepth_core.obstacles.separation import ObstacleLimits
    from cvcdepth_core.pointcloud import CloudLimits


LIDAR_TOLERANCE = 0.1
"""Seconds that a LiDAR sweep may be from the image that it is the truth of, unless something else is asked for."""

AUTO = "auto"
"""Name of the rig that the node finds among the live topics."""

CHANGEABLE_WHILE_RUNNING = (
    "checkpoint",
    "cloud_stride",
    "cloud_min_range",
    "cloud_max_range",
    "cloud_voxel",
    "cloud_min_confidence",
    "cloud_min_height",
    "cloud_max_height",
    "cloud_edge_clearance",
    "obstacle_min_height",
    "obstacle_max_height",
    "obstacle_max_range",
    "scan_resolution",
)
"""Parameters of the node that need not wait until it is cleaned up."""

_SMALLEST_VOXEL = 0.01
_UNTRAINED_DEPTHS = (1.5, 200.0)  # metres: least and greatest depth of a network with random weights


class Settings(BaseModel):
    """Base of all settings: immutable; unknown fields are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class ModelSettings(Settings):
    """Which network estimates depth, and where it runs."""

    checkpoint: str = ""
    """Checkpoint file (safetensors) of the depth network; without one, or 'default', the package's own small model."""
    checkpoint_sha256: str = Field("", pattern="^([0-9a-f]{64})?$")
    """SHA-256 that the checkpoint file must have, 64 hexadecimal digits; empty takes any."""
    untrained: bool = False
    """Run a network with random weights instead of a checkpoint. Its depth has the right form and no meaning."""
    encoder: str = "resnet18"
    """Untrained network only: resnet18, resnet34 or efficientnet_lite0. A checkpoint names its own."""
    height: int = Field(384, ge=32, le=4096, multiple_of=32)
    """Untrained network only: rows of its input. A checkpoint names its own."""
    width: int = Field(640, ge=32, le=4096, multiple_of=32)
    """Untrained network only: columns of its input. A checkpoint names its own."""
    device: str = "auto"
    """Where inference runs: auto (CUDA where there is one), cpu, cuda, cuda:1 ..."""
    backend: Backend = "auto"
    """What runs the network: auto (on a CPU ncnn, or openvino where it is installed and quicker, else torch) or one by
    name."""
    precision: Precision = "float32"
    """In what a CUDA device computes; CPUs know float32 only."""
    cpu_fallback: bool = False
    """Go on with the CPU, more slowly, when the GPU fails, or its memory is too small even for one camera."""
    refine: Literal["auto", "geometry", "off"] = "off"
    """What is made of the network's depth: off leaves it, geometry compares pictures of neighbours and earlier ones,
    auto does so where odometry or /tf tells how the vehicle moves."""
    refine_width: int = Field(160, ge=32, le=4096)
    """Refinement and confidence only: columns of the grid that pictures are compared on, at most; more is slower."""
    flip_fusion: bool = False
    """Run the network on mirrored pictures too and fuse both depths, as the paper's best rows do: twice the cost."""

    @property
    def checkpoint_path(self) -> Path | None:
        """The checkpoint's file; None for a network with random weights."""
        return None if self.untrained else checkpoint_path(self.checkpoint)

    @property
    def fusion(self) -> FlipFusion:
        """What is fused."""
        return "depth" if self.flip_fusion else "none"

    @property
    def notice(self) -> str:
        """A warning about what the network's depth is worth; empty for a checkpoint of the user's own."""
        if self.untrained:
            return "untrained: the network has random weights, and its depth means nothing"
        return NOTICE if self.checkpoint in ("", DEFAULT) else ""

    def build_estimator(self) -> "DepthEstimator":
        """Return the checkpoint's network, or an untrained one; CheckpointError or ConfigError says what is wrong."""
        from cvcdepth_core.estimator import DepthEstimator

        engine = self.model_dump(include={"backend", "precision", "cpu_fallback"}) | {"flip_fusion": self.fusion}
        path = self._checked_path()
        if path is not None:
            return DepthEstimator.from_checkpoint(path, self.device, **engine)
        return DepthEstimator.untrained(self._untrained_spec(), self.device, **engine)

    def build_network(self) -> "tuple[DepthNetwork, DepthModelSpec]":
        """Return that network by itself, and what it is for; raises as `build_estimator`."""
        from cvcdepth_core.estimator import untrained_network
        from cvcdepth_core.networks.checkpoint import load_checkpoint

        path = self._checked_path()
        if path is not None:
            checkpoint = load_checkpoint(path)
            return checkpoint.build_depth_net(), checkpoint.spec
        spec = self._untrained_spec()
        return untrained_network(spec), spec

    def _checked_path(self) -> Path | None:
        from cvcdepth_core.networks.checkpoint import check_sha256

        path = self.checkpoint_path
        if path is not None:
            check_sha256(path, self.checkpoint_sha256)
        return path

    def _untrained_spec(self) -> "DepthModelSpec":
        from cvcdepth_core.networks.registry import DepthModelSpec

        least, greatest = _UNTRAINED_DEPTHS
        try:
            return DepthModelSpec(
                encoder=self.encoder, height=self.height, width=self.width, min_depth=least, max_depth=greatest
            )
        except ValidationError as error:
            raise ConfigError(f"parameter {first_validation_message(error)}") from error


class MatchingSettings(Settings):
    """Which images make a surround set."""

    tolerance: float = Field(default=0.1, gt=0, le=10)
    """Seconds that two images of one set may be apart."""
    queue_size: int = Field(default=10, ge=2, le=1000)
    """Images that are kept per camera while their set is not complete."""


class MissingCameraSettings(Settings):
    """How many cameras a set needs."""

    min_cameras: int = Field(0, ge=0, le=64)
    """Cameras without which no set is made: with fewer than all, dead cameras are left out; 0 holds such sets back."""


class SkySettings(Settings):
    """What becomes of the sky."""

    sky: Literal["far", "nan", "keep"] = "far"
    """Depth of the sky: far (inf, as REP 118 has it), nan, or keep (what the network says). Clouds have none of it."""


class OutputSettings(SkySettings):
    """Encoding of the depth images and limits of the merged cloud."""

    depth_encoding: Literal["32FC1", "16UC1"] = "32FC1"
    """Encoding of depth images: 32FC1 metres with NaN for unknown, or 16UC1 millimetres with 0 (REP 118)."""
    cloud_stride: int = Field(2, ge=1, le=64)
    """Merged cloud: every n-th row and column."""
    cloud_min_range: float = Field(0.5, ge=0, le=1e4)
    """Merged cloud: metres from a camera below which points are left out."""
    cloud_max_range: float = Field(80.0, gt=0, le=1e4)
    """Merged cloud: metres from a camera above which points are left out."""
    cloud_voxel: float = Field(0.0, ge=0, le=100)
    """Merged cloud: edge in metres of the cubes that keep one point each, at least 0.01; 0 keeps all points."""
    cloud_min_confidence: float = Field(0.0, ge=0, le=1)
    """Clouds: confidence below which pixels make no points; 0 takes all."""
    depth_min_confidence: float = Field(0.0, ge=0, le=1)
    """Depth images: confidence below which depth is left unknown; 0 takes all."""

    cloud_min_height: float = Field(-1000.0, ge=-1e4, le=1e4)
    """Merged cloud: z in the base frame, metres, below which points are left out."""
    cloud_max_height: float = Field(1000.0, ge=-1e4, le=1e4)
    """Merged cloud: z in the base frame, metres, above which points are left out."""
    cloud_edge_clearance: float = Field(0.0, ge=0, le=10)
    """Merged cloud and obstacles: leave out edges of depth, that is surfaces that would pass nearer than so many metres
    by their camera; 0 keeps them."""
    cloud_deskew: bool = False
    """Merged cloud and what is made of it: move every camera's points to the anchor's moment, by the vehicle's motion
    (odometry, /tf, or with refinement the pictures); points stay where they are while that is not known."""
    cloud_persistence: int = Field(0, ge=0, le=10)
    """Merged cloud and what is made of it: keep points near which each of so many earlier sets had one too, where the
    vehicle's motion is known; 0 keeps all."""
    cloud_times: bool = False
    """Merged cloud, obstacles and ground: a field t, the seconds by which a point was seen later than the stamp."""
    obstacle_min_height: float = Field(0.3, ge=0, le=100)
    """Obstacles: metres above the ground that was found from which points are obstacles, and no ground."""
    obstacle_max_height: float = Field(2.0, gt=0, le=100)
    """Obstacles: metres above the ground that the vehicle fits below."""
    obstacle_max_range: float = Field(40.0, gt=0, le=1e4)
    """Obstacles, ground and scan: metres from the base frame."""
    scan_resolution: float = Field(0.5, ge=0.05, le=30)
    """Scan: degrees between two beams."""

    @field_validator("cloud_voxel")
    @classmethod
    def _check_voxel(cls, metres: float) -> float:
        if 0 < metres < _SMALLEST_VOXEL:
            raise ValueError(f"{metres} is neither 0 nor at least {_SMALLEST_VOXEL}")
        return metres

    @property
    def cloud_limits(self) -> "CloudLimits":
        """Which points the merged cloud keeps."""
        from cvcdepth_core.pointcloud import CloudLimits

        return CloudLimits(
            self.cloud_stride,
            self.cloud_min_range,
            self.cloud_max_range,
            self.cloud_voxel,
            self.cloud_min_confidence,
            self.cloud_min_height,
            self.cloud_max_height,
            self.cloud_edge_clearance,
        )

    @property
    def obstacle_limits(self) -> "ObstacleLimits":
        """What is an obstacle."""
        from cvcdepth_core.obstacles.separation import ObstacleLimits

        return ObstacleLimits(self.obstacle_min_height, self.obstacle_max_height, self.obstacle_max_range)

    @property
    def scan_limits(self) -> "ScanLimits":
        """What the scan is like."""
        from cvcdepth_core.obstacles.scan import ScanLimits

        return ScanLimits(self.scan_resolution)

    @model_validator(mode="after")
    def _check_heights(self) -> "OutputSettings":
        for kind in ("cloud", "obstacle"):
            least, most = getattr(self, f"{kind}_min_height"), getattr(self, f"{kind}_max_height")
            if least >= most:
                raise ValueError(f"{kind}_min_height {least:g} must be below {kind}_max_height {most:g}")
        return self

    @property
    def needs_poses(self) -> bool:
        """Whether any output depends on where the vehicle was at the exposures."""
        return self.cloud_deskew or self.cloud_persistence > 0

    @property
    def needs_confidence(self) -> bool:
        """Whether any output depends on confidence."""
        return self.cloud_min_confidence > 0 or self.depth_min_confidence > 0


class NodeParameters(OutputSettings, MissingCameraSettings, MatchingSettings, ModelSettings):
    """Everything that can be set for the node; the docstring of each field is its ROS description."""

    rig: str = AUTO
    """Rig file (YAML), or 'auto': find the cameras among the live topics and their poses on /tf_static."""
    base_frame: str = "base_link"
    """With rig 'auto': the vehicle's frame. A rig file names its own."""
    autostart: bool = True
    """Configure and activate at start; switch off where a lifecycle manager does that."""
    max_age: float = Field(0.5, ge=0, le=3600)
    """Seconds (ROS time) after which a waiting set is not worth inference any more; 0 takes any age."""
    max_image_mb: float = Field(64.0, gt=0, le=2000)
    """Megabytes above which an image message is refused; queue_size such images are kept per camera at most."""
    reliable: bool = False
    """Subscribe images and camera_info reliably instead of with sensor-data QoS."""
    stale_after: float = Field(1.0, gt=0, le=3600)
    """Seconds without an image after which a camera counts as stale."""
    frozen_after: float = Field(1.0, ge=0, le=3600)
    """Seconds of the very same picture after which a camera counts as frozen and is left out; 0 accepts any."""
    overlap_monitor: bool = True
    """Compare neighbouring cameras in their overlaps, to tell of a shifted mount or a dirty lens in /diagnostics."""
    odometry_topic: str = ""
    """Refinement only: a nav_msgs/Odometry topic with the vehicle's motion; empty: /tf has it, or else the pictures."""
    publish_odometry: bool = False
    """Publish the motion that the pictures tell as ~/odometry (nav_msgs/Odometry); its scale is that of the depth."""
    publish_tf: bool = True
    """Publish the camera poses of a rig file on /tf_static, but for frames that TF has already."""
    trace: str = ""
    """File for a trace of every stage that https://ui.perfetto.dev opens; at most 64 MB."""

    def check_complete(self) -> None:
        """Raise ConfigError where the parameters are each possible but together not enough to start with."""
        if not self.rig:
            raise ConfigError(f"parameter rig is empty: name a rig file, or '{AUTO}'")
        if self.untrained and self.checkpoint:
            raise ConfigError(
                f"parameters checkpoint '{self.checkpoint}' and untrained true: a checkpoint is trained; name none "
                "to run random weights"
            )
