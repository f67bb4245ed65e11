# SPDX-License-Identifier: Apache-2.0
"""The training configuration: typed, validated, read from YAML files that may build on one another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from cvcdepth_core.errors import ConfigError, validation_messages
from cvcdepth_core.files import load_yaml
from cvcdepth_core.model_choices import DEFAULT, EncoderName, checkpoint_path
from cvcdepth_core.networks.checkpoint import load_spec
from cvcdepth_core.networks.pose import MAX_TRANSLATION
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.augmentation import ColorJitterConfig, FlipMode
from cvcdepth_core.training.model import PoseMethod
from cvcdepth_core.training.novel_views import NovelViewsConfig
from cvcdepth_core.training.objective import ObjectiveConfig

ExposureMotion = Literal["auto", "recorded", "network", "none"]
Supervision = Literal["none", "lidar", "depth"]
MotionSource = Literal["auto", "recorded", "network"]

_BASE_KEY = "base"


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class PoseConfig(_Section):
    """The pose network."""

    encoder: EncoderName = "resnet18"
    """Backbone."""
    method: PoseMethod = "front"
    """Which motion is predicted from which images; see `SurroundModel`."""


class AugmentationConfig(_Section):
    """Changes to samples; but for `zoom`, the losses compare the unchanged pictures."""

    color_jitter: ColorJitterConfig = ColorJitterConfig()
    """Random colour changes, per camera."""
    flip: FlipMode = "both"
    """Hflip-S: which networks see half of the samples mirrored."""
    zoom: float = Field(default=1.0, ge=1, le=4)
    """Of recordings: a random window of each camera's pictures takes their place, down to one of this many parts of
    their width, with its own calibration, so that there are other lenses to learn from; 1 takes whole pictures."""


class RecordingsConfig(_Section):
    """Which moments of recordings become training samples, and how they are read."""

    held_out: float = Field(default=0.25, ge=0, lt=1)
    """The last share of every recording's surround sets that is never trained on."""
    min_travel: float = Field(default=0.1, ge=0, allow_inf_nan=False)
    """Metres between a sample's target and each of its context frames, at least; nearer sets are passed over."""
    max_travel: float = Field(default=MAX_TRANSLATION, gt=0, allow_inf_nan=False)
    """Metres between them at most, where motion is recorded; with `motion: network` never more than the 4 that the pose
    network can tell."""
    min_image_change: float = Field(default=2.0, ge=0, allow_inf_nan=False)
    """Instead of `min_travel` where no motion is recorded: mean absolute difference of the anchor camera's small grey
    pictures, of 255."""
    further_travels: tuple[float, ...] = ()
    """Where `motion` is recorded: further least distances, in metres; every epoch draws for each target whether it is
    `min_travel` or one of these. Longer ways show depth that is far away, and the pose network other speeds."""
    max_interval: float = Field(default=0.5, gt=0, allow_inf_nan=False)
    """Seconds from a target to a context frame, at most: a longer gap of the recording is not bridged. Where motion is
    recorded, one and a half times the recording's own time from set to set is allowed too."""
    motion: MotionSource = "network"
    """From where the losses know how the cameras moved between a sample's sets: `network` (the pose network's answer,
    as in the published method), `recorded` (odometry or /tf, from exposure to exposure of each camera, which the pose
    network is taught too, see `objective.recorded_motion`), or `auto` (recorded where a recording has some, else of the
    network). Recorded motion gives the scale, so that a camera needs no neighbour then."""
    exposure_motion: ExposureMotion = "auto"
    """How the vehicle moved between the exposures of one set, which gives the place of each camera when it fired:
    `recorded` (odometry or /tf), `network` (as the pose network says, at constant velocity between two sets), `auto`
    (recorded where there is some, else of the network), or `none`, as in the published method, which takes the
    exposures as simultaneous. `true` is `auto`, `false` is `none`."""
    supervise: Supervision = "none"
    """Whether depth is learnt from recorded truth too, beside the pictures: `lidar` (the sweep nearest to each picture,
    moved by the recorded motion, without the points that a camera cannot see; of recordings that have one), or `depth`
    (true depth images, as `simulate` records them)."""
    tolerance: float = Field(default=0.1, gt=0, le=10)
    """Seconds that two images of one set may be apart."""
    workers: int = Field(default=0, ge=0)
    """Processes that read and decode; 0 does it in the training process."""
    cache_mb: int = Field(default=512, ge=0)
    """Rectified pictures that each process keeps in memory, MB; 0 decodes every picture anew."""

    @field_validator("exposure_motion", mode="before")
    @classmethod
    def _exposure_motion_may_be_switched(cls, value: Any) -> Any:
        return {True: "auto", False: "none"}[value] if isinstance(value, bool) else value


class WorldsConfig(_Section):
    """How views of rendered worlds become samples; calibration and truth follow every change of the picture."""

    zoom: float = Field(default=1.5, ge=1, le=4)
    """A random window of the picture, as wide as the picture or down to one of this many parts of it."""
    squeeze: float = Field(default=0.07, ge=0, le=0.5)
    """Standard deviation of the logarithm of the pixels' width over their height."""
    angle_error: float = Field(default=0.5, ge=0, le=10)
    """Degrees, standard deviation of pitch and roll that the network is told wrongly."""
    height_error: float = Field(default=0.04, ge=0, le=0.5)
    """Share of the camera's height, standard deviation, by which the network is told it wrongly."""
    held_out: float = Field(default=0.03, ge=0, lt=1)
    """The last share of the drives, which is scored and never trained on."""
    share: float = Field(default=0.5, ge=0, lt=1)
    """Of `finetune --worlds`: which share of the pictures whose depth is learnt comes from worlds, in every step; 0
    scores the worlds and learns from none. `--keep-general` takes its place."""
    weight: float = Field(default=1.0, gt=0)
    """Of `finetune --worlds`: by how much more a picture of a world counts in a step than one of a recording."""


class OptimizerConfig(_Section):
    """Adam, its learning-rate schedule, and limits on a step."""

    learning_rate: float = Field(default=1e-4, gt=0)
    """Initial learning rate."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay of Adam's two moments."""
    epochs: int = Field(default=20, ge=1)
    """Number of passes over the training samples."""
    decay_after_epochs: int = Field(default=15, ge=1)
    """Epochs after each of which the learning rate is multiplied by `decay_factor`."""
    decay_factor: float = Field(default=0.1, gt=0, le=1)
    """See `decay_after_epochs`."""
    schedule: Literal["steps", "cosine"] = "steps"
    """`steps` is that of the two fields before; `cosine` goes from `learning_rate` to a hundredth of it in a run."""
    warm_up: int = Field(default=0, ge=0)
    """Steps in which the learning rate rises from nothing."""
    encoder_rate: float = Field(default=1.0, gt=0, le=1)
    """Share of the learning rate that the encoders have: less for what begins with ImageNet's weights."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Decoupled (AdamW); 0 is the published Adam."""
    samples_per_step: int = Field(default=4, ge=1)
    """Samples, of all cameras each, whose gradients make one step: processes x samples per process x accumulation."""
    samples_per_batch: int = Field(default=1, ge=1)
    """Samples that go through a process's networks together; a divisor of `samples_per_step`."""
    max_gradient_norm: float | None = Field(default=None, gt=0)
    """Longer gradients are shortened to this."""
    average_decay: float | None = Field(default=None, gt=0, lt=1)
    """Decay per step of the weights' moving average; with it, the average is what is validated and saved."""
    autocast: Literal["none", "bfloat16", "auto"] = "none"
    """Precision of the networks; views and losses stay in float32. `auto` is bfloat16 on CPUs that multiply it
    (AVX512-BF16, AMX) and none elsewhere; a run goes on with what it began with."""
    compile: bool = False
    """Have torch.compile translate the networks at the first step, which takes minutes and a C++ compiler."""

    @model_validator(mode="after")
    def _batches_make_steps(self) -> OptimizerConfig:
        if self.samples_per_step % self.samples_per_batch:
            raise ValueError(
                f"samples_per_step is {self.samples_per_step}, expected a multiple of samples_per_batch "
                f"({self.samples_per_batch})"
            )
        return self


class EvaluationConfig(_Section):
    """Scoring of predictions during the run."""

    max_depth: float = Field(default=200.0, gt=0, le=1e4)
    """Metres; ground truth at or beyond it is left out, predictions are clamped to it."""
    sets: int = Field(default=20, ge=2)
    """Held-out sets, at most, that a validation during the run scores; at its start and end all are scored."""
    patience: int | None = Field(default=None, ge=1)
    """Validations in a row without a better score after which the run ends; null: it never ends early."""
    refine: Literal["off", "geometry"] = "off"
    """Whether depth is refined before it is scored, as the node's parameter refine has it."""


class TrainingConfig(_Section):
    """Everything that determines a training run."""

    dataset: Literal["ddad", "nuscenes", "recording", "worlds"] = "ddad"
    """Where samples come from: recordings, or shards of `simulate`; of the data sets there is no reader yet."""
    depth: DepthModelSpec
    """The depth network; checkpoints carry this."""
    pose: PoseConfig = PoseConfig()
    """The pose network."""
    objective: ObjectiveConfig = ObjectiveConfig()
    """Weights and variants of the loss."""
    augmentation: AugmentationConfig = AugmentationConfig()
    """Changes to samples."""
    synthesis: NovelViewsConfig = NovelViewsConfig()
    """For the objective's `synthesis_...` terms: how far the cameras are turned."""
    recordings: RecordingsConfig = RecordingsConfig()
    """For `dataset: recording`: which moments become samples, and how they are read."""
    worlds: WorldsConfig = WorldsConfig()
    """For pre-training on rendered worlds: how their views become samples."""
    optimizer: OptimizerConfig = OptimizerConfig()
    """Adam, its learning-rate schedule, and limits on a step."""
    evaluation: EvaluationConfig = EvaluationConfig()
    """Scoring of predictions during the run."""
    validate_every: int = Field(default=1, ge=1)
    """Epochs between two validations; the last epoch is always validated."""
    checkpoint_every: int = Field(default=200, ge=1)
    """Steps between two checkpoints; there is one at the end of every epoch too."""
    pictures_every: int = Field(default=200, ge=1)
    """Steps between two sets of pictures for the run's observers, from the first step on."""
    seed: int = Field(default=42, ge=0)
    """Seed of all random draws, which do not depend on the number of processes."""

    @model_validator(mode="after")
    def _pose_consistency_has_poses_to_compare(self) -> TrainingConfig:
        if self.objective.pose_consistency > 0 and self.pose.method != "per_camera":
            raise ValueError(
                f"objective.pose_consistency is {self.objective.pose_consistency}, which compares the cameras' own "
                f"motions, but pose.method is {self.pose.method!r}, expected 'per_camera'"
            )
        return self

    @model_validator(mode="after")
    def _synthesis_has_a_volume(self) -> TrainingConfig:
        loss, volume = self.objective, self.depth.volume
        if loss.synthesises and (volume is None or volume.skips):
            raise ValueError(
                f"objective.synthesis_consistency is {loss.synthesis_consistency:g} and synthesis_smoothness "
                f"{loss.synthesis_smoothness:g}, but depth.network is {self.depth.network}, "
                + ("expected vfdepth" if volume is None else "whose skips show a turned camera another one's picture")
            )
        return self


def load_training_config(path: str | Path, start: DepthModelSpec | None = None) -> TrainingConfig:
    """Read a training configuration; `base: FILE` names a file, relative to this one, that it builds on.

    What it does not say of the network is as in `start`, what the weights that training begins with are for; a file
    without a word of it, and without a start, means the network of the package's own model.

    Raises ConfigError naming the file, the field, the value found and what is allowed.
    """
    path = Path(path)
    try:
        return TrainingConfig.model_validate(_with_network(_read_with_bases(path, above=()), start))
    except ValidationError as error:
        raise ConfigError(f"{path}: {validation_messages(error, TrainingConfig)}") from error


def load_dataset(path: str | Path) -> Any:
    """Return what `dataset` a training configuration names, valid or not; ConfigError names a file that is no YAML."""
    default = TrainingConfig.model_fields["dataset"].default
    return _read_with_bases(Path(path), above=()).get("dataset", default)


def _with_network(fields: dict[str, Any], start: DepthModelSpec | None) -> dict[str, Any]:
    named = fields.get("depth", {})
    if start is None and "depth" not in fields:
        start = load_spec(checkpoint_path(DEFAULT))
    if start is None or not isinstance(named, dict):
        return fields
    width = named.get("width")
    # Depth goes with fx / focal_scale, and fx with the width.
    scale = width / start.width if isinstance(width, int) else 1.0
    known = {"network": start.network, **start.model_dump(), "focal_scale": start.focal_scale * scale}
    if named.get("network", start.network) != start.network:
        for part in ("volume", "cross_view"):
            known.pop(part, None)
    return {**fields, "depth": known | named}


def _read_with_bases(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    if path.resolve() in above:
        raise ConfigError(f"{path}: {_BASE_KEY} leads back to the file itself")
    fields = _read_yaml(path)
    base = fields.pop(_BASE_KEY, None)
    if base is None:
        return fields
    if not isinstance(base, str):
        raise ConfigError(f"{path}: {_BASE_KEY} is {base!r}, expected the name of a file")
    return _overlay(_read_with_bases(path.parent / base, (*above, path.resolve())), fields)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: holds a {type(content).__name__}, expected fields with values")
    return content


def _overlay(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        merged[key] = _overlay(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged
