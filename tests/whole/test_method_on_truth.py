# SPDX-License-Identifier: Apache-2.0
"""The method where truth is known: on a rendered drive, no term of the objective prefers what is wrong to what is true.

The recording in samples/world_excerpt has three surround sets of six cameras with exact depth and motion.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from repository import ROOT
from torch import Tensor

from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import RecordingsConfig, TrainingConfig
from cvcdepth_core.training.objective import (
    ObjectiveConfig,
    Prediction,
    evaluate_objective,
    masked_errors,
    synthesise_views,
)
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import open_evaluation
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import RecordingIndex, build_index
from cvcdepth_ros.training_data.loader import RecordingBatches

DRIVE = ROOT / "samples" / "world_excerpt"
HEIGHT, WIDTH = 128, 224
SPEC = DepthModelSpec(encoder="efficientnet_lite0", height=HEIGHT, width=WIDTH, min_depth=0.4, max_depth=250)
CONFIG = TrainingConfig(dataset="recording", depth=SPEC, recordings=RecordingsConfig(held_out=0.0))
OBJECTIVE = ObjectiveConfig(corrected=True)
SKY = 250.0  # metres, the farthest that the network can say


@cache
def index() -> RecordingIndex:
    return build_index(DRIVE, MatchingSettings())


@cache
def batch() -> RigBatch:
    """The one sample that there is: the second set between the first and the third."""
    (sample,) = RecordingBatches([index()], CONFIG).epoch(0)
    assert sample is not None
    return sample.to(dtype=torch.float64)


@cache
def true_depth() -> Tensor:
    """[1, N, 1, H, W]."""
    settings = EvaluationSettings(truth="depth", predictor="constant", height=HEIGHT, width=WIDTH)
    with open_evaluation(EvaluationJob("drive", str(DRIVE), settings)) as evaluation:
        sets = list(evaluation.sets(*evaluation.window))
    depth = np.stack([np.nan_to_num(truth.image(), nan=SKY) for truth in sets[1].truth])
    return torch.from_numpy(depth).double()[None, :, None]


@cache
def true_motions() -> Tensor:
    """[1, 2, N, 4, 4]: how each camera's points at its exposure of the second set lie at those of first and third."""
    mounts = np.stack([camera.base_T_camera for camera in index().layout.complete().cameras])
    world_T_camera = index().poses @ mounts
    motions = [[inverse(world_T_camera[s, n]) @ world_T_camera[1, n] for n in range(len(mounts))] for s in (0, 2)]
    return torch.tensor(np.array(motions))[None]


def terms(
    depth: Tensor, motions: Tensor, changed: RigBatch | None = None, config: ObjectiveConfig = OBJECTIVE
) -> dict[str, float]:
    """The value of each term, mean over the cameras."""
    prediction = Prediction(1 / depth, depth, motions)
    noise = torch.zeros(1, 2, depth.shape[1], 1, HEIGHT, WIDTH, dtype=torch.float64)
    value = evaluate_objective(changed or batch(), prediction, config, noise)
    return {name: float(term.mean()) for name, term in value.terms.items()}


@cache
def at_truth() -> dict[str, float]:
    return terms(true_depth(), true_motions())


def tilted(depth: Tensor, share: float) -> Tensor:
    """Depth that grows from the left to the right of every picture by this share."""
    return depth * torch.linspace(1 - share / 2, 1 + share / 2, WIDTH, dtype=torch.float64)


def one_camera(depth: Tensor, scale: float) -> Tensor:
    scales = torch.ones(depth.shape[1], dtype=torch.float64)
    scales[0] = scale
    return depth * scales[:, None, None, None]


WRONG_DEPTHS = {
    **{f"scale {scale}": (lambda depth, s=scale: s * depth) for scale in (0.8, 0.9, 0.95, 1.05, 1.1, 1.2)},
    **{f"one camera {scale}": (lambda depth, s=scale: one_camera(depth, s)) for scale in (0.85, 1.15)},
    **{f"tilt {share}": (lambda depth, s=share: tilted(depth, s)) for share in (-0.3, 0.3)},
}
PHOTOMETRIC = ("temporal", "spatial", "spatio_temporal", "reconstruction_consistency")


@pytest.mark.parametrize("wrong", WRONG_DEPTHS.values(), ids=WRONG_DEPTHS)
def test_every_photometric_term_is_lower_at_the_true_depth(wrong):
    found = terms(wrong(true_depth()), true_motions())
    assert {name: found[name] > at_truth()[name] for name in PHOTOMETRIC} == dict.fromkeys(PHOTOMETRIC, True)


@pytest.mark.parametrize("name", [name for name in WRONG_DEPTHS if not name.startswith("scale")])
def test_the_neighbours_depth_agrees_best_at_the_true_depth(name: str):
    found = terms(WRONG_DEPTHS[name](true_depth()), true_motions())
    assert found["depth_consistency"] > 1.15 * at_truth()["depth_consistency"]


def test_the_neighbours_depth_is_the_same_but_at_outlines():
    prediction = Prediction(1 / true_depth(), true_depth(), true_motions())
    views = synthesise_views(batch(), prediction, OBJECTIVE)
    error, mask = masked_errors(batch(), prediction, views, OBJECTIVE)["depth_consistency"]
    seen = (mask > 0) & (true_depth() < 50)
    assert int(seen.sum()) > 3000
    relative = (error / true_depth())[seen]
    assert float(relative.median()) < 0.01
    assert float((relative > 0.1).double().mean()) < 0.25


def test_agreement_in_metres_by_itself_draws_depth_near():
    """A known property of the published term (method section 6), which its small weight makes up for; see the next."""
    scales = [terms(s * true_depth(), true_motions())["depth_consistency"] for s in (0.8, 0.9, 1.0, 1.1, 1.2)]
    assert scales == sorted(scales)


@pytest.mark.parametrize("name", WRONG_DEPTHS)
def test_agreement_as_a_share_is_best_at_the_true_depth(name: str):
    """What no scale makes smaller by itself shows what overlaps know of the scale, weak as their baselines are."""
    relative = OBJECTIVE.model_copy(update={"depth_difference": "share"})
    found = terms(WRONG_DEPTHS[name](true_depth()), true_motions(), config=relative)["depth_consistency"]
    assert found > terms(true_depth(), true_motions(), config=relative)["depth_consistency"]


@pytest.mark.parametrize("factor", [0.7, 0.85, 1.15, 1.3])
def test_the_terms_of_the_way_are_lower_at_the_true_motion(factor: float):
    motions = true_motions().clone()
    motions[..., :3, 3] *= factor
    found = terms(true_depth(), motions)
    assert found["temporal"] > at_truth()["temporal"]
    assert found["spatio_temporal"] > at_truth()["spatio_temporal"]


@pytest.mark.parametrize("degrees", [-1.5, 1.5])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_terms_of_the_overlap_are_lower_at_the_true_mounts(axis: int, degrees: float):
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]] if axis == 0 else [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    mounts = batch().base_T_camera.clone()
    mounts[:, 0] = mounts[:, 0] @ torch.from_numpy(turn)
    found = terms(true_depth(), true_motions(), replace(batch(), base_T_camera=mounts))
    assert found["spatial"] > at_truth()["spatial"]
    assert found["spatio_temporal"] > at_truth()["spatio_temporal"]
    assert found["temporal"] == pytest.approx(at_truth()["temporal"])  # looks at no other camera


@cache
def slopes(what: str, share: float) -> dict[str, float]:
    """By how much each term grows with the scale of all depth, of one camera's, or of the way, where that is wrong."""
    factor = torch.tensor(share, dtype=torch.float64, requires_grad=True)
    depth, motions = true_depth(), true_motions()
    if what == "way":
        way = torch.cat([factor.expand(3), torch.ones(1)])[:, None] * motions[..., 3:]
        motions = torch.cat([motions[..., :3], way], dim=-1)
    elif what == "one camera":
        depth = torch.cat([depth[:, :1] * factor, depth[:, 1:]], dim=1)
    else:
        depth = depth * factor
    noise = torch.zeros(1, 2, depth.shape[1], 1, HEIGHT, WIDTH, dtype=torch.float64)
    value = evaluate_objective(batch(), Prediction(1 / depth, depth, motions), OBJECTIVE, noise)
    every = {name: term.mean() for name, term in value.terms.items()} | {"loss": value.loss}
    return {
        name: float(torch.autograd.grad(term, factor, retain_graph=True)[0])
        for name, term in every.items()
        if term.requires_grad
    }


LED_BY = {
    "scale": ("loss", *PHOTOMETRIC),
    "one camera": ("loss", "temporal", "spatial", "spatio_temporal", "depth_consistency"),
    "way": ("loss", "temporal", "spatio_temporal"),
}


@pytest.mark.parametrize("share", [0.9, 1.1])
@pytest.mark.parametrize(("what", "name"), [(what, name) for what, names in LED_BY.items() for name in names])
def test_the_gradient_of_the_loss_and_of_each_term_leads_back_from_what_is_wrong(what: str, name: str, share: float):
    assert slopes(what, share)[name] * (share - 1) > 0


@cache
def untold() -> RigBatch:
    """The same sample when nobody tells that the cameras fired one after another, as in the published method."""
    at_once = CONFIG.recordings.model_copy(update={"exposure_motion": "none"})
    (sample,) = RecordingBatches([index()], CONFIG.model_copy(update={"recordings": at_once})).epoch(0)
    assert sample is not None
    return sample.to(dtype=torch.float64)


@pytest.mark.parametrize("name", ["spatial", "spatio_temporal"])
def test_cameras_that_fire_in_turn_agree_only_where_their_exposures_are_told(name: str):
    spread = np.ptp(index().times[1]) / 1e9
    assert spread > 0.04
    assert terms(true_depth(), true_motions(), untold())[name] > 1.03 * at_truth()[name]


def test_the_recording_goes_through_check_and_evaluate(tmp_path, capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(DRIVE), "--json"]) == 0
    assert '"failed"' not in capsys.readouterr().out
    options = ["--truth", "depth", "--predictor", "ground_plane", "--no-report", "--quiet", "--json"]
    assert main(["evaluate", str(DRIVE), *options, "-o", str(tmp_path)]) == 0
    assert sum(path.stat().st_size for path in DRIVE.iterdir()) < 3 * 2**20
