# SPDX-License-Identifier: Apache-2.0
"""A checkpoint's pose network by itself: what it is asked, what its answers are worth, what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks import DepthModelSpec, DepthNet, PoseNet
from cvcdepth_core.networks.checkpoint import load_checkpoint, save_checkpoint
from cvcdepth_core.training.pose_network import PoseAnswers, PoseScore, motion_error, pose_score_to_json

SPEC = DepthModelSpec(encoder="efficientnet_lite0", height=64, width=96, min_depth=0.5, max_depth=80)

INTRINSICS = np.tile([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]], (3, 1, 1))


class Telling(torch.nn.Module):
    """Answers with one translation, and remembers what it saw."""

    def __init__(self, metres: tuple[float, float, float]) -> None:
        super().__init__()
        self.metres, self.seen = metres, []

    def forward(self, earlier: torch.Tensor, later: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.seen.append((earlier, later))
        return torch.zeros(1, 3), torch.tensor([self.metres])


def saved(path: Path, network: PoseNet | None, **metadata: str) -> Path:
    state = None if network is None else network.state_dict()
    save_checkpoint(path, SPEC, DepthNet(SPEC.encoder).state_dict(), state, metadata)
    return path


def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(2)
    return [rng.integers(0, 256, (3, 64, 96, 3), dtype=np.uint8) for _ in range(2)]


@pytest.mark.parametrize(("method", "views"), [("front", 1), ("per_camera", 1), ("joint_front", 3), ("joint", 3)])
def test_it_sees_the_pictures_that_it_was_trained_with(method, views):
    network, frames = Telling((0.0, 0.0, -0.5)), pictures()
    mounts = np.tile(np.eye(4), (3, 1, 1))
    mounts[1, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # optical: z ahead is the vehicle's x
    motion = PoseAnswers(network, method).later_T_earlier(frames[0], frames[1], mounts, 1, INTRINSICS)
    ((earlier, later),) = network.seen
    assert earlier.shape == later.shape == (1, views, 3, 64, 96)
    shown = earlier[0, 0 if views == 1 else 1].permute(1, 2, 0) * 255
    np.testing.assert_allclose(shown.numpy(), frames[0][1], atol=1e-3)
    expected = (0, 0.5, 0) if method == "joint" else (0, 0, -0.5)  # the vehicle's z is the camera's -y
    np.testing.assert_allclose(motion[:3, 3], expected, atol=1e-6)


def test_the_answers_of_a_checkpoint_are_those_of_its_network(tmp_path):
    torch.manual_seed(3)
    network = PoseNet("resnet18").eval()
    config = json.dumps({"pose": {"encoder": "resnet18", "method": "front"}})
    answers = PoseAnswers.from_checkpoint(load_checkpoint(saved(tmp_path / "a.safetensors", network, config=config)))
    frames = pictures()
    with torch.inference_mode():
        views = [torch.from_numpy(frame[:1]).permute(0, 3, 1, 2)[None].float() / 255 for frame in frames]
        _, translation = network(*views)
    motion = answers.later_T_earlier(frames[0], frames[1], np.tile(np.eye(4), (3, 1, 1)), 0, INTRINSICS)
    np.testing.assert_allclose(motion[:3, 3], translation[0].numpy(), rtol=1e-5)


def test_without_a_configuration_the_depth_networks_encoder_is_taken_and_without_weights_there_is_none(tmp_path):
    plain = load_checkpoint(saved(tmp_path / "plain.safetensors", PoseNet(SPEC.encoder)))
    assert PoseAnswers.from_checkpoint(plain) is not None
    assert PoseAnswers.from_checkpoint(load_checkpoint(saved(tmp_path / "none.safetensors", None))) is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("{", "its metadata `config` is no configuration"),
        ('{"pose": {"method": "psychic"}}', "its pose.method is 'psychic', not one of"),
        ('{"pose": {"encoder": "resnet18"}}', "wrong.safetensors: pose network"),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused_by_file_and_value(tmp_path, config, message):
    checkpoint = load_checkpoint(saved(tmp_path / "wrong.safetensors", PoseNet(SPEC.encoder), config=config))
    with pytest.raises(CheckpointError, match=message):
        PoseAnswers.from_checkpoint(checkpoint)


def test_an_answer_is_worth_its_way_along_the_recorded_one_and_its_angle():
    recorded, half, aside = np.eye(4), np.eye(4), np.eye(4)
    recorded[2, 3], half[2, 3], aside[0, 3] = -0.8, -0.4, 0.8
    half[:3, :3] = [[np.cos(0.02), 0, np.sin(0.02)], [0, 1, 0], [-np.sin(0.02), 0, np.cos(0.02)]]
    found = motion_error(half, recorded)
    assert found == pytest.approx((0.4, 0.8, np.degrees(0.02)), rel=1e-6)
    assert motion_error(aside, recorded).predicted == pytest.approx(0)
    assert motion_error(half, np.eye(4)) is None


def test_scores_of_recordings_are_joined_by_their_ways_and_steps():
    one, two = PoseScore(3, 1.0, 2.0, 0.1), PoseScore(1, 3.0, 3.0, 0.5)
    joined = PoseScore.joined([one, two])
    assert joined == pytest.approx((4, 4.0, 5.0, 0.2))
    assert joined.ratio == pytest.approx(0.8)
    assert [score.is_trusted for score in (one, two)] == [False, True]
    assert PoseScore.joined([]) is None
    assert pose_score_to_json(None) == {
        "steps": 0,
        "predicted_metres": None,
        "recorded_metres": None,
        "degrees": None,
        "ratio": None,
    }
    assert pose_score_to_json(joined).keys() == pose_score_to_json(None).keys()
