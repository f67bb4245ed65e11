# SPDX-License-Identifier: Apache-2.0
"""The ground is found in pictures of the road from two known places, and refused where they do not carry it."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from solid_world import Rectangle, camera_matrix, pose, render
from surround_drive import looking

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import PinholeView
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate
from cvcdepth_core.rig_health.ground_pictures import FEWEST_PAIRS, GroundFromPictures, RoadView, shows_road

SIZE, FOCAL = (192, 320), 220.0
K = camera_matrix(*SIZE, FOCAL)
SCENE = np.ones(SIZE, bool)
MOUNTS = {"front": looking(x=1.2, z=1.1), "back": looking(180.0, x=-1.0, z=1.0)}
STEP = 0.8


def rig_of(mounts: dict[str, np.ndarray]) -> Rig:
    calibration = Calibration(width=SIZE[1], height=SIZE[0], k=tuple(K.ravel()))
    return Rig(tuple(Camera(name, calibration, mount) for name, mount in mounts.items()), "base_link", "front", {})


def ground(height: float, contrast: float = 60.0) -> Rectangle:
    """Flat ground."""
    placed = pose(z=height)
    placed[:3, :3] = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # its x axis looks up
    return Rectangle(placed, seed=3, wavelengths=(0.15, 2.0), contrast=contrast)


def seen(surfaces: list[Rectangle], world_T_base: np.ndarray, mount: np.ndarray, first_T_base: np.ndarray) -> RoadView:
    picture, _ = render(surfaces, world_T_base @ mount, K, SIZE)
    return RoadView(picture, SCENE, PinholeView(K, first_T_base @ mount, *SIZE))


def search(
    surfaces: list[Rectangle],
    mounts: dict[str, np.ndarray] = MOUNTS,
    step: float = STEP,
    told_step: float | None = None,
    moments: int = 4,
) -> GroundFromPictures:
    """The pairs of a drive along x; `told_step` is what odometry says of each step."""
    found = GroundFromPictures(rig_of(mounts))
    told = step if told_step is None else told_step
    for number in range(moments):
        for mount in mounts.values():
            start = pose(x=3.0 * number)
            found.add(
                seen(surfaces, start, mount, np.eye(4)), seen(surfaces, start @ pose(x=step), mount, pose(x=told))
            )
    return found


@pytest.mark.parametrize("height", [-0.42, 0.0, 0.25])
def test_the_height_of_flat_ground_is_found(height: float):
    found = search([ground(height)]).estimate()
    assert found.height == pytest.approx(height, abs=0.02)
    assert 0 < found.uncertainty < 0.08
    assert found.describes.startswith("from pictures, 8 pairs, +-0.0")


def test_two_cameras_that_see_the_same_road_at_once_show_it_without_any_motion():
    mounts = {"left": looking(x=1.2, y=0.35, z=1.1), "right": looking(-5.0, x=1.2, y=-0.35, z=1.1)}
    found = GroundFromPictures(rig_of(mounts))
    for number in range(3):
        left, right = (seen([ground(-0.42)], pose(x=4.0 * number), mount, np.eye(4)) for mount in mounts.values())
        found.add(left, right)
        found.add(right, left)
    assert found.estimate().height == pytest.approx(-0.42, abs=0.03)


def test_what_stands_on_the_road_does_not_lift_it():
    car = [Rectangle(pose(x=x, z=0.8), 0.9, 0.8, 7, (0.2, 1.5)) for x in (7.0, 13.0)]
    walls = [Rectangle(pose(y=side, yaw=90), seed=5) for side in (-6.0, 6.0)]
    assert search([ground(0.0), *car, *walls]).estimate().height == pytest.approx(0.0, abs=0.04)


def refusal(collect: Callable[[], GroundFromPictures]) -> str:
    with pytest.raises(RigError) as error:
        collect().estimate()
    return str(error.value)


def test_a_vehicle_that_stands_still_tells_nothing():
    assert "0 pairs of pictures" in refusal(lambda: search([ground(0.0)], step=0.0))


def test_a_road_without_texture_tells_nothing():
    assert f"0 pairs of pictures show a road with texture from two places, {FEWEST_PAIRS} are needed" in refusal(
        lambda: search([ground(0.0, contrast=2.0)])
    )


def test_odometry_that_turns_where_the_vehicle_does_not_fits_no_ground():
    found = GroundFromPictures(rig_of(MOUNTS))
    for number in range(4):
        for mount in MOUNTS.values():
            start = pose(x=3.0 * number)
            found.add(
                seen([ground(0.0)], start, mount, np.eye(4)),
                seen([ground(0.0)], start @ pose(x=STEP), mount, pose(x=STEP, yaw=15.0)),
            )
    assert "fit" in refusal(lambda: found)


def test_a_wrong_focal_length_or_odometry_shows_as_a_wrong_height():
    """Both scale the camera's height above the ground alike: which of them it is, the road alone cannot tell."""
    found: GroundEstimate = search([ground(0.0)], told_step=STEP * 1.2).estimate()
    heights = [mount[2, 3] for mount in MOUNTS.values()]
    assert np.mean(heights) - found.height == pytest.approx(1.2 * np.mean(heights), rel=0.03)
    longer = np.diag([1.2, 1.2, 1.0]) @ K
    longer[:2, 2] = K[:2, 2]
    wrong = GroundFromPictures(rig_of(MOUNTS))
    for number in range(4):
        for mount in MOUNTS.values():
            start = pose(x=3.0 * number)
            views = (
                seen([ground(0.0)], start, mount, np.eye(4)),
                seen([ground(0.0)], start @ pose(x=STEP), mount, pose(x=STEP)),
            )
            wrong.add(*(one._replace(view=replace(one.view, intrinsics=longer)) for one in views))
    assert np.mean(heights) - wrong.estimate().height == pytest.approx(np.mean(heights) / 1.2, rel=0.03)


def test_cameras_that_look_at_the_sky_or_aside_show_no_road():
    blank = np.zeros((*SIZE, 3), np.uint8)
    for mount, shows in [
        (MOUNTS["front"], True),
        (MOUNTS["back"], True),
        (looking(90.0, z=1.1), False),
        (MOUNTS["front"] @ pitched(60.0), False),
    ]:
        assert shows_road(RoadView(blank, SCENE, PinholeView(K, mount, *SIZE))) is shows
    assert not shows_road(RoadView(blank, np.zeros(SIZE, bool), PinholeView(K, MOUNTS["front"], *SIZE)))


def pitched(degrees: float) -> np.ndarray:
    """A turn of a camera about its own x axis: up for angles above 0."""
    a, turn = math.radians(degrees), np.eye(4)
    turn[1:3, 1:3] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    return turn
