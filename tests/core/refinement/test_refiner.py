# SPDX-License-Identifier: Apache-2.0
"""Refined depth against exact truth, and what must leave the prior as it is, bit for bit."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from solid_world import Rectangle, pose, street
from surround_drive import SECOND, Drive, looking, ring, straight

from cvcdepth_core.errors import ConfigError, ImageError
from cvcdepth_core.refinement.moments import SurroundMoment
from cvcdepth_core.refinement.refiner import RefinedDepth, SurroundRefiner
from cvcdepth_core.refinement.settings import RefinementSettings

ONE = np.stack([looking()])
SIDEWAYS = np.stack([looking(yaw=90)])
TWO = np.stack([looking(yaw=-12, y=-0.3), looking(yaw=12, y=0.3)])
PAIR = [(0, 1), (1, 0)]
WALL = [Rectangle(pose(x=6.0), seed=3, wavelengths=(0.3, 2.4))]
GREY_WALL = [Rectangle(pose(x=6.0), contrast=0.0)]


def driven(drive: Drive, times: list[float], prior: float = 1.0, neighbours=(), **settings: Any) -> RefinedDepth:
    """What becomes of the last of the sets at these times, seconds."""
    refiner = SurroundRefiner(neighbours, RefinementSettings(**settings))
    return [refiner.refine(drive.moment(time, prior)) for time in times][-1]


def errors(refined: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(refined - truth)[~np.isnan(truth)] / truth[~np.isnan(truth)]


def bits(refined: RefinedDepth) -> list[bytes]:
    return [getattr(refined, name).tobytes() for name in ("depth", "confidence", "prior_confidence", "checked")]


@pytest.mark.parametrize("prior", [0.67, 0.8, 1.25, 1.5])
def test_a_prior_that_is_off_is_put_right_by_motion(prior: float):
    drive = Drive(WALL, ONE, straight((0.0, 4.0, 0.0)))
    refined = driven(drive, [0.0, 0.1, 0.2, 0.3], prior)
    assert np.median(errors(refined.depth, drive.moment(0.3).depth)) < 0.02
    assert np.mean(errors(refined.depth, drive.moment(0.3).depth) < 0.05) > 0.85


def test_a_street_around_the_vehicle_is_put_right_in_all_cameras():
    drive = Drive(street(), ring(4, 50), straight((5.0, 0.0, 0.0)))
    neighbours = [(0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2)]
    refined = driven(drive, [0.0, 0.1, 0.2, 0.3], 1.3, neighbours)
    truth = drive.moment(0.3).depth
    for camera in range(4):
        found = errors(refined.depth[camera], truth[camera])
        assert np.median(found) < 0.06
        assert found.mean() < 0.15


def test_neighbours_alone_put_the_overlap_right_at_standstill():
    drive = Drive(WALL, TWO, straight())
    refined = driven(drive, [0.0, 0.1], 1.3, PAIR)
    truth = drive.moment(0.0).depth
    checked = refined.confidence > 0
    assert 0.3 < checked.mean() < 0.95
    assert np.median(errors(np.where(checked, refined.depth, np.nan)[checked], truth[checked])) < 0.02


@pytest.mark.parametrize(
    ("surfaces", "velocity"), [(WALL, (0.0, 0.0, 0.0)), (GREY_WALL, (0.0, 4.0, 0.0))], ids=["standing", "no texture"]
)
def test_without_parallax_or_texture_the_prior_stays_bit_for_bit(surfaces: list[Rectangle], velocity):
    drive = Drive(surfaces, ONE, straight(velocity))
    refined = driven(drive, [0.0, 0.1, 0.2, 0.3], 1.3)
    assert refined.depth.tobytes() == drive.moment(0.3, 1.3).depth.tobytes()
    assert not refined.confidence.any()
    assert not refined.prior_confidence.any()


def test_where_nothing_could_be_checked_confidence_is_zero():
    first = driven(Drive(WALL, ONE, straight((0.0, 4.0, 0.0))), [0.0])
    assert not first.confidence.any()
    assert not first.prior_confidence.any()
    assert not first.checked.any()


@pytest.mark.parametrize("lost", ["masked", "turned away"])
def test_a_neighbour_that_shows_nothing_of_it_leaves_a_camera_as_it_is(lost: str):
    mounts = np.stack([looking(), looking(yaw=180)]) if lost == "turned away" else TWO
    moment = Drive(WALL, mounts, straight()).moment(0.0, 1.3)
    if lost == "masked":
        moment = replace(moment, valid=moment.valid & np.array([True, False])[:, None, None])
    refined = SurroundRefiner(PAIR).refine(moment)
    assert refined.depth.tobytes() == moment.depth.tobytes()
    assert not refined.confidence.any()


def test_unknown_depth_stays_unknown_and_nothing_else_becomes_so():
    drive = Drive(street(), ring(4, 50), straight((5.0, 0.0, 0.0)))
    refiner = SurroundRefiner([(0, 1), (1, 0)])
    for time in (0.0, 0.1, 0.2):
        moment = drive.moment(time, 1.2)
        moment.depth[1, 30:50, 20:70] = np.nan
        refined = refiner.refine(moment)
        assert np.array_equal(np.isnan(refined.depth), np.isnan(moment.depth))
        assert not refined.confidence[1, 32:48, 22:68].any()


def test_the_order_of_the_cameras_does_not_matter():
    mounts, order = ring(4, 50), [2, 0, 3, 1]
    pairs = [(0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2)]
    permuted = [(order.index(a), order.index(b)) for a, b in pairs]
    way, times = straight((5.0, 0.0, 0.0)), [0.0, 0.1, 0.2]
    one = driven(Drive(street(), mounts, way), times, 1.2, pairs)
    other = driven(Drive(street(), mounts[order], way), times, 1.2, permuted)
    np.testing.assert_allclose(one.depth[order], other.depth, rtol=1e-4)
    np.testing.assert_allclose(one.confidence[order], other.confidence, atol=1e-3)


def test_a_camera_that_fails_for_a_set_changes_no_bit_of_cameras_that_are_not_its_neighbours():
    drive = Drive(street(), ring(4, 50), straight((5.0, 0.0, 0.0)))
    pairs = [(0, 1), (1, 0), (2, 3), (3, 2)]
    healthy, failing = SurroundRefiner(pairs), SurroundRefiner(pairs)
    for time in (0.0, 0.1, 0.2, 0.3, 0.4):
        moment = drive.moment(time, 1.2)
        whole = healthy.refine(moment)
        found = failing.refine(without(moment, 3) if time == 0.2 else moment)
        for camera in (0, 1):
            assert whole.depth[camera].tobytes() == found.depth[camera].tobytes()
            assert whole.confidence[camera].tobytes() == found.confidence[camera].tobytes()
        if time == 0.2:
            assert np.isnan(found.depth[3]).all()
            assert not found.confidence[3].any()
    assert found.checked[3] > 0.5  # it resumed with the pictures from before


def without(moment: SurroundMoment, camera: int) -> SurroundMoment:
    depth, pictures, present, times = (
        getattr(moment, name).copy() for name in ("depth", "pictures", "present", "times_ns")
    )
    depth[camera], pictures[camera], present[camera], times[camera] = np.nan, 0, False, 0
    return replace(moment, depth=depth, pictures=pictures, present=present, times_ns=times)


def test_exposures_eighty_milliseconds_apart_need_the_pose_of_each():
    drive = Drive(WALL, TWO, straight((0.0, 10.0, 0.0)), delays=(0.0, 0.08))
    moment = drive.moment(0.0)
    one_pose = replace(moment, world_T_base=np.repeat(moment.world_T_base[:1], 2, axis=0))
    exact, wrong = (SurroundRefiner(PAIR).refine(m) for m in (moment, one_pose))
    seen = (exact.confidence > 0) & (wrong.confidence > 0)
    assert np.median(errors(exact.depth[seen], moment.depth[seen])) < 0.02
    assert np.median(errors(wrong.depth[seen], moment.depth[seen])) > 0.1


def test_what_moves_along_deceives_earlier_pictures_by_the_computed_factor_and_neighbours_not_at_all():
    car = Rectangle(pose(x=5.0, y=0.6), 1.2, 0.8, seed=8, wavelengths=(0.2, 1.5), velocity=(0.0, 1.2, 0.0))
    drive = Drive([*WALL, car], TWO, straight((0.0, 4.0, 0.0)))
    moment = drive.moment(0.3)
    on_car = np.abs(moment.depth - drive_depth_of(car, drive)) < 0.05
    alone = driven(drive, [0.2, 0.3], distances=(0.3,), use_neighbours=False)
    beside = driven(drive, [0.3], neighbours=PAIR)
    assert on_car.mean() > 0.05
    factor = 4.0 / (4.0 - 1.2)
    assert np.median(alone.depth[on_car] / moment.depth[on_car]) == pytest.approx(factor, rel=0.05)
    seen = on_car & (beside.confidence > 0.6)
    assert seen.sum() > 100
    assert np.median(errors(beside.depth[seen], moment.depth[seen])) < 0.02


def drive_depth_of(surface: Rectangle, drive: Drive) -> np.ndarray:
    """Depth of one surface alone, at 0.3 s, NaN elsewhere."""
    return Drive([surface], drive.base_T_camera, drive.way).moment(0.3).depth


def test_a_vehicle_ahead_is_not_pushed_to_the_horizon():
    car = Rectangle(pose(x=8.0), 1.0, 0.8, seed=8, wavelengths=(0.3, 1.5), velocity=(5.0, 0.0, 0.0))
    wall = Rectangle(pose(x=30.0), seed=2, wavelengths=(1.0, 8.0))
    drive = Drive([car, wall], ONE, straight((5.0, 0.0, 0.0)))
    refined = driven(drive, [0.0, 0.2, 0.4, 0.6, 0.8])
    moment = drive.moment(0.8)
    on_car = moment.depth < 9.0
    assert (
        np.median(refined.depth[on_car] / moment.depth[on_car]) < 1.45
    )  # without the guard: 2.2, the farthest there is


def test_mirrored_pictures_give_mirrored_depth():
    drive = Drive(street(), ring(3, 50), straight((5.0, 1.0, 0.0)))
    pairs = [(0, 1), (1, 0), (1, 2), (2, 1)]
    plain, mirrored = SurroundRefiner(pairs), SurroundRefiner(pairs)
    for time in (0.0, 0.1, 0.2, 0.3):
        moment = drive.moment(time, 1.2)
        one, other = plain.refine(moment), mirrored.refine(mirror(moment))
    np.testing.assert_allclose(np.flip(other.depth, 2), one.depth, rtol=2e-3)


def mirror(moment: SurroundMoment) -> SurroundMoment:
    """The set that cameras would take in the world seen in a mirror that stands along the way."""
    in_world, in_camera = np.diag([1.0, -1, 1, 1]), np.diag([-1.0, 1, 1, 1])
    intrinsics = moment.intrinsics.copy()
    intrinsics[:, 0, 2] = moment.depth.shape[2] - 1 - intrinsics[:, 0, 2]
    return replace(
        moment,
        depth=np.flip(moment.depth, 2).copy(),
        pictures=np.flip(moment.pictures, 2).copy(),
        intrinsics=intrinsics,
        base_T_camera=in_world @ moment.base_T_camera @ in_camera,
        world_T_base=in_world @ moment.world_T_base @ in_world,
    )


def test_the_same_sets_give_the_same_bits():
    drive = Drive(street(), ring(3, 50), straight((5.0, 0.0, 0.0)))
    moments = [drive.moment(time, 1.2) for time in (0.0, 0.1, 0.2)]
    one, other = SurroundRefiner([(0, 1)]), SurroundRefiner([(0, 1)])
    for moment in moments:
        assert bits(one.refine(moment)) == bits(other.refine(moment))


def test_a_reset_forgets_all_that_was_before():
    drive = Drive(WALL, ONE, straight((0.0, 4.0, 0.0)))
    moments = [drive.moment(time, 1.3) for time in (0.0, 0.1, 0.2)]
    refiner = SurroundRefiner([])
    for moment in moments:
        refiner.refine(moment)
    refiner.reset()
    assert bits(refiner.refine(moments[-1])) == bits(SurroundRefiner([]).refine(moments[-1]))


@pytest.mark.parametrize("change", ["time goes back", "position jumps", "other lens", "other mount"])
def test_a_set_that_cannot_follow_the_last_begins_anew(change: str):
    drive = Drive(WALL, ONE, straight((0.0, 4.0, 0.0)))
    refiner = SurroundRefiner([])
    for time in (0.0, 0.1, 0.2):
        refiner.refine(drive.moment(time, 1.3))
    moment = drive.moment(0.3, 1.3)
    if change == "time goes back":
        moment = replace(moment, times_ns=moment.times_ns - 2 * SECOND)
    elif change == "position jumps":
        moment = replace(moment, world_T_base=pose(y=40.0) @ moment.world_T_base)
    elif change == "other lens":
        moment = replace(moment, intrinsics=moment.intrinsics * 1.01)
    else:
        moment = replace(moment, base_T_camera=moment.base_T_camera @ pose(x=0.01))
    assert not refiner.refine(moment).confidence.any()


def test_while_the_motion_is_unknown_neighbours_alone_count_and_nothing_is_kept():
    drive = Drive(WALL, TWO, straight((0.0, 4.0, 0.0)))
    moments = [replace(drive.moment(time, 1.3), world_T_base=None) for time in (0.0, 0.1, 0.2)]
    refiner = SurroundRefiner(PAIR)
    found = [refiner.refine(moment) for moment in moments]
    assert bits(found[-1]) == bits(SurroundRefiner(PAIR).refine(moments[-1]))
    assert 0 < found[-1].checked.max() < 1


def test_a_set_without_motion_in_between_forgets_nothing():
    drive = Drive(WALL, ONE, straight((0.0, 4.0, 0.0)))
    refiner = SurroundRefiner([])
    for time in (0.0, 0.1, 0.2):
        moment = drive.moment(time, 1.3)
        refined = refiner.refine(replace(moment, world_T_base=None) if time == 0.1 else moment)
    assert refined.checked[0] > 0.8


def test_a_finer_grid_tells_more_exactly():
    drive = Drive(street(), ONE, straight((3.0, 4.0, 0.0)))
    truth = drive.moment(0.3).depth
    coarse, fine = (
        errors(driven(drive, [0.0, 0.1, 0.2, 0.3], 1.3, max_grid_width=width).depth, truth).mean()
        for width in (80, 160)
    )
    assert fine < 0.9 * coarse < 0.15


def test_confidence_is_larger_where_depth_is_right():
    drive = Drive(street(), ring(4, 50), straight((5.0, 0.0, 0.0)))
    refined = driven(drive, [0.0, 0.1, 0.2, 0.3], 1.5)
    truth = drive.moment(0.3).depth
    right = np.abs(np.log(refined.depth / truth)) < np.log(1.25)
    assert 0.6 < right.mean() < 0.999
    assert refined.confidence[right].mean() > refined.confidence[~right].mean() + 0.1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pictures", r"pictures is \[1, 48, 160, 3\], but depth is \[1, 96, 160\]: \[1, 96, 160, 3\] is expected"),
        ("world_T_base", r"world_T_base is \[1, 2, 4\], .* \[1, 4, 4\] is expected"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name_and_size(name: str, message: str):
    moment = Drive(WALL, ONE, straight()).moment(0.0)
    with pytest.raises(ImageError, match=message):
        replace(moment, **{name: getattr(moment, name)[:, ::2]})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"bins": 8}, "bins is 8, must be odd and at least 5"),
        ({"temperature": 0.0}, "temperature is 0.0, must be positive"),
        ({"distances": (0.3, -1.0)}, r"distances are \(0.3, -1.0\), must be positive"),
    ],
)
def test_settings_that_mean_nothing_are_refused(wrong: dict, message: str):
    with pytest.raises(ConfigError, match=message):
        RefinementSettings(**wrong)
