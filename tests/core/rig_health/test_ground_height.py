# SPDX-License-Identifier: Apache-2.0
"""The ground is found in LiDAR sweeps, whatever stands on it, and nothing is told where they do not show it."""

import math

import numpy as np
import pytest
from simple_worlds import short_drive, two_cameras

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate, GroundFromSweeps
from cvcdepth_core.worlds.description import Ground
from cvcdepth_core.worlds.drive import SimulatedDrive
from cvcdepth_core.worlds.rendering.lidar import lidar_mount

RIG = two_cameras().complete()
SENSOR = np.array([0.9, 0.0, 1.9])


def seen_surface(height: float, ahead: float = 0.0, left: float = 0.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """What a LiDAR of 32 beams sees of a plane: rings, dense near the vehicle; angles in degrees."""
    rng = np.random.default_rng(seed)
    elevations, azimuths = np.radians(np.linspace(-25, -2, 32)), np.radians(np.arange(0, 360, 0.5))
    e, a = (grid.ravel() for grid in np.meshgrid(elevations, azimuths))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    normal = np.array([-math.tan(math.radians(ahead)), -math.tan(math.radians(left)), 1.0])
    middle = np.append(np.mean([camera.base_T_camera[:2, 3] for camera in RIG.cameras], axis=0), height)
    distances = ((middle - SENSOR) @ normal) / (rays @ normal)
    seen = (distances > 0) & (distances < 60)
    return SENSOR + rays[seen] * (distances[seen] + rng.normal(0, noise, seen.sum()))[:, None]


def found(*sweeps: np.ndarray, rig: Rig = RIG, sensor: np.ndarray = SENSOR) -> GroundEstimate:
    search = GroundFromSweeps(rig)
    for points in sweeps:
        search.add(points, sensor)
    return search.estimate()


@pytest.mark.parametrize(("ahead", "left"), [(0.0, 0.0), (2.0, -1.0), (-1.5, 3.0)])
@pytest.mark.parametrize("height", [-0.42, 0.0, 0.3])
def test_a_plane_is_found_exactly_with_its_tilt(height: float, ahead: float, left: float):
    ground = found(seen_surface(height, ahead, left))
    assert ground.height == pytest.approx(height, abs=1e-3)
    assert (ground.rise_ahead, ground.rise_left) == pytest.approx((ahead, left), abs=0.05)


def test_noise_averages_out_and_the_uncertainty_tells_how_much_is_left():
    ground = found(*(seen_surface(-0.42, noise=0.03, seed=seed) for seed in range(8)))
    assert ground.height == pytest.approx(-0.42, abs=0.01)
    assert 0 < ground.uncertainty <= 0.02
    assert ground.describes == "from LiDAR, 8 sweeps, +-0.01"


def block(x: tuple[float, float], y: tuple[float, float], z: float, spacing: float = 0.04) -> np.ndarray:
    """The level top of something, seen densely."""
    xs, ys = np.meshgrid(np.arange(*x, spacing), np.arange(*y, spacing))
    return np.stack([xs.ravel(), ys.ravel(), np.full(xs.size, z)], axis=1)


def beside(points: np.ndarray) -> np.ndarray:
    """Those of pavements left, hard by the vehicle, and right."""
    return points[(points[:, 1] > 1.3) | (points[:, 1] < -3.5)]


@pytest.mark.parametrize(
    "thing",
    [
        block((-1.5, 2.5), (-0.9, 0.9), 1.2),
        block((5.0, 9.0), (-0.9, 0.9), 0.9),
        beside(seen_surface(0.13, noise=0.02)),
        np.random.default_rng(0).uniform((-15, -8, -6), (15, 8, -0.5), (60, 3)),
    ],
    ids=["the vehicle's own roof", "the car ahead", "pavements beside it", "reflections below the road"],
)
def test_nothing_else_is_taken_for_the_ground(thing: np.ndarray):
    ground = seen_surface(0.0, noise=0.02)
    covered = cells_of(thing[thing[:, 2] > 0])  # what stands on the ground hides it
    hidden = np.array([cell in covered for cell in map(tuple, np.floor(ground[:, :2] / 0.2).astype(int))])
    assert found(np.concatenate([ground[~hidden], thing])).height == pytest.approx(0.0, abs=0.012)


def cells_of(points: np.ndarray) -> set[tuple[int, int]]:
    return {(int(x), int(y)) for x, y in np.unique(np.floor(points[:, :2] / 0.2), axis=0)}


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.empty((0, 3)), "1 of 1 LiDAR sweeps show no ground: 0 points near the vehicle are below its cameras"),
        (seen_surface(2.5), "0 points near the vehicle are below its cameras"),
        (block((-9.0, 9.0), (-2.0, 2.0), 0.25, 0.2), "scans one plane only"),
        (np.random.default_rng(0).uniform((-12, -2, -3), (12, 2, 1.5), (3000, 3)), "no plane: "),
        (np.full((50, 3), np.nan), "0 points near"),
    ],
    ids=["nothing", "all above the cameras", "a scanner in one plane", "leaves", "not a number"],
)
def test_sweeps_without_ground_are_refused_with_the_reason(points: np.ndarray, words: str):
    sensor = np.array([0.5, 0.0, 0.25]) if "one plane" in words else SENSOR
    with pytest.raises(RigError, match=words):
        found(points, sensor=sensor)


def test_sweeps_that_disagree_are_refused_with_what_they_say():
    with pytest.raises(RigError, match=r"do not agree on the ground: -1\.00 to 0\.00 m"):
        found(*(seen_surface(-height) for height in (0.0, 0.5, 1.0, 0.2)))


def test_the_ground_of_a_simulated_street_is_where_its_base_frame_stands():
    pytest.importorskip("embreex", reason="worlds need embreex")
    spec = short_drive()
    assert spec.sensors.lidar is not None
    lidar = spec.sensors.lidar.model_copy(update={"beams": 32, "columns": 600, "noise": 0.02})
    street = spec.world.model_copy(update={"ground": Ground(margin=20.0)})
    drive = SimulatedDrive(
        spec.model_copy(update={"sensors": spec.sensors.model_copy(update={"lidar": lidar}), "world": street})
    )
    mount, sweeps = lidar_mount(lidar), []
    for number in range(3):
        sweep = drive.sweep(number)
        assert sweep is not None
        sweeps.append(sweep.points @ mount[:3, :3].T + mount[:3, 3])
    ground = found(*sweeps, rig=drive.rig, sensor=mount[:3, 3])
    assert ground.height == pytest.approx(0.0, abs=0.02)
    assert ground.rise_ahead == pytest.approx(0.0, abs=0.3)
