# SPDX-License-Identifier: Apache-2.0
"""What the objective leaves out and evens out, on rendered streets: standing, following, and cameras that differ."""

from functools import cache

import numpy as np
import pytest
import torch
from rendered_drive import TrueDrive, pinhole_rig
from simple_worlds import street_spec

from cvcdepth_core.training import objective
from cvcdepth_core.training.objective import (
    ObjectiveConfig,
    Prediction,
    evaluate_objective,
    masked_errors,
    synthesise_views,
)
from cvcdepth_core.worlds.description import Drive, Motion, Vehicle
from cvcdepth_core.worlds.drive import DriveSpec
from cvcdepth_core.worlds.sensors import CameraLook, Sensors

pytest.importorskip("embreex", reason="worlds need embreex")

OBJECTIVE = ObjectiveConfig(corrected=True)
RIG = pinhole_rig((0.0, 45.0), (128, 80), 75.0)
SPEED = 6.0
LEADER = Vehicle(at=(30.0, -1.6), kind="van", motion=Motion(speeds=((0.0, SPEED),)))


@cache
def drive(speed: float = SPEED, keys: tuple[float, ...] = (0.3,)) -> TrueDrive:
    """Half a second behind a van, which is as fast as the vehicle if that moves; exposures are fixed."""
    looks = tuple(CameraLook(exposure="fixed", key=key) for key in keys)
    street = street_spec()
    world = street.model_copy(
        update={"vehicles": (*street.vehicles, LEADER), "drive": Drive(at=(20.0, -1.6), speeds=((0.0, speed),))}
    )
    return TrueDrive(
        DriveSpec(layout=RIG, world=world, sensors=Sensors(stagger=0.0, lidar=None, looks=looks), seconds=0.5)
    )


def prediction_of(rendered: TrueDrive, scale: float = 1.0, way: float = 1.0) -> Prediction:
    depth = scale * rendered.depth(1)
    motions = rendered.motions(1, 0, 2)
    motions[..., :3, 3] *= way
    return Prediction(1 / depth, depth, motions)


def counted(rendered: TrueDrive, prediction: Prediction) -> np.ndarray:
    """Which pixels [N, H, W] the auto-mask lets the temporal term count."""
    batch = rendered.batch(1, 0, 2)
    views = synthesise_views(batch, prediction, OBJECTIVE)
    noise = torch.randn(1, 2, 2, 1, 80, 128, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    _, mask = masked_errors(batch, prediction, views, OBJECTIVE, noise)["temporal"]
    return mask[0, :, 0].numpy() > 0


def test_the_auto_mask_keeps_out_a_vehicle_of_equal_speed_and_lets_the_street_count():
    rendered = drive()
    mask, found = counted(rendered, prediction_of(rendered)), rendered.true_set(1)
    leader = rendered.drive.world.names.index(LEADER.kind)
    on_it = found.objects[0] == leader
    street = (found.depth < 12.0) & ~np.isin(found.objects, [mover.number for mover in rendered.drive.world.movers])
    assert on_it.sum() > 100
    assert mask[0][on_it].mean() < 0.15
    assert mask[street].mean() > 0.6  # the others have too little texture, or hardly move: the road far ahead


def test_the_auto_mask_keeps_a_standing_vehicle_out_whatever_motion_is_believed():
    rendered = drive(0.0)
    believed = prediction_of(rendered)
    believed.motions[..., 2, 3] += torch.tensor([0.3, -0.3], dtype=torch.float64)[None, :, None]
    still = ~np.isin(rendered.true_set(1).objects, [0, *(mover.number for mover in rendered.drive.world.movers)])
    assert counted(rendered, believed)[still].mean() < 0.05


def terms(rendered: TrueDrive, scale: float = 1.0) -> dict[str, float]:
    noise = torch.zeros(1, 2, 2, 1, 80, 128, dtype=torch.float64)
    value = evaluate_objective(rendered.batch(1, 0, 2), prediction_of(rendered, scale), OBJECTIVE, noise)
    return {name: float(term.mean()) for name, term in value.terms.items()}


UNEQUAL = (0.2, 0.45)


@pytest.mark.parametrize("name", ["spatial", "spatio_temporal"])
def test_cameras_that_expose_differently_are_brought_to_agree(name: str, monkeypatch: pytest.MonkeyPatch):
    equal, unequal = terms(drive(keys=(0.3, 0.3)))[name], terms(drive(keys=UNEQUAL))[name]
    monkeypatch.setattr(objective, "align_intensity", lambda warped, *_, **__: warped)
    as_they_are = terms(drive(keys=UNEQUAL))[name]
    assert unequal < 1.2 * equal
    assert as_they_are > 1.3 * unequal


@pytest.mark.parametrize("scale", [0.85, 0.93, 1.07, 1.15])
def test_the_true_depth_is_the_best_for_cameras_that_expose_differently(scale: float):
    rendered = drive(keys=UNEQUAL)
    for name in ("spatial", "spatio_temporal", "reconstruction_consistency"):
        assert terms(rendered, scale)[name] > terms(rendered)[name]
