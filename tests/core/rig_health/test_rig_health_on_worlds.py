# SPDX-License-Identifier: Apache-2.0
"""The overlap monitor and the search for the own body on rendered streets, where what is true is known."""

import itertools
from functools import cache

import numpy as np
import pytest
from rendered_drive import TrueDrive, pinhole_rig, turned, with_camera_of
from simple_worlds import street_spec

from cvcdepth_core.rig_health.overlap_monitor import OverlapMonitor
from cvcdepth_core.rig_health.own_body import MIN_PAIRS, SelfOcclusionFinder
from cvcdepth_core.worlds.description import Drive
from cvcdepth_core.worlds.drive import DriveSpec
from cvcdepth_core.worlds.sensors import Sensors
from cvcdepth_core.worlds.shapes.own_body import BodyKind

pytest.importorskip("embreex", reason="worlds need embreex")

RING = pinhole_rig((0.0, 60.0, 120.0, 180.0, -120.0, -60.0), (128, 80), 80.0)
SETS = 5
ORDER = (*range(SETS), *range(SETS - 2, 0, -1))
SECOND = 10**9


def looped(layout=RING) -> TrueDrive:
    world = street_spec(drive=Drive(at=(20.0, -1.6), speeds=((0.0, 4.0),)))
    sensors = Sensors(rate=4.0, stagger=0.0, lidar=None)
    return TrueDrive(DriveSpec(layout=layout, world=world, sensors=sensors, seconds=SETS / 4.0, samples=1))


@cache
def intact() -> list:
    """Sets of the drive forwards and backwards, with true depth."""
    drive = looped()
    return [drive.surround(number) for number in ORDER]


@cache
def with_one_turned(camera: int, axis: int) -> list:
    """The same with one camera turned by a degree against the rig, its depth true for how it really looks."""
    wrong = turned(RING, camera, 1.0, axis)
    alone = looped(wrong.model_copy(update={"cameras": (wrong.cameras[camera],)}))
    return [with_camera_of(surround, alone.surround(n), camera) for surround, n in zip(intact(), ORDER, strict=True)]


def test_nobody_is_named_on_an_intact_rig_in_ten_minutes():
    """The sets of a drive there and back, one a second, for ten minutes of the stamps' time."""
    monitor = OverlapMonitor(RING.complete())
    for number in range(600):
        monitor.update(intact()[number % len(intact())], number * SECOND)
        assert not monitor.findings(), f"second {number}: {[str(found) for found in monitor.findings()]}"


@pytest.mark.parametrize(("camera", "axis"), [(1, 1), (3, 0)])
def test_the_camera_that_was_turned_is_named_and_no_other(camera: int, axis: int):
    monitor, name = OverlapMonitor(RING.complete()), f"camera_{camera}"
    for number in range(120):
        monitor.update(intact()[number % len(intact())], number * SECOND // 10)
        assert not monitor.findings()
    changed, named = with_one_turned(camera, axis), set()
    for number in range(120, 180):
        monitor.update(changed[number % len(changed)], number * SECOND // 10)
        named |= {name for found in monitor.findings() for name in found.cameras}
    assert named == {name}


LOOKING = pinhole_rig((0.0, 70.0, 180.0), (192, 120), 95.0, pitch=-14.0)


def searched(body: BodyKind) -> tuple[np.ndarray, np.ndarray]:
    """What was found to be scene, and what really is [N, 240, 384]."""
    world = street_spec(drive=Drive(at=(16.0, -1.6), speeds=((0.0, 8.0),)))
    sensors = Sensors(rate=10.0, stagger=0.0, lidar=None, body=body)
    drive = TrueDrive(DriveSpec(layout=LOOKING, world=world, sensors=sensors, seconds=(MIN_PAIRS + 1) / 10, samples=1))
    finder = SelfOcclusionFinder(drive.rig)
    raw = [drive.true_set(number) for number in range(MIN_PAIRS + 1)]
    rectified = [
        [finder.preprocessor.rectify(camera, picture) for camera, picture in enumerate(found.pictures)] for found in raw
    ]
    for earlier, later in itertools.pairwise(rectified):
        finder.add(earlier, later)
    own = np.repeat(np.repeat(raw[0].objects == 1, 2, axis=1), 2, axis=2)
    return finder.scene(), ~own


def test_the_own_body_is_found_where_it_is_and_only_there():
    """A mirror on its arm; bonnet and roof are so smooth that they show the street alone, and are not told from it."""
    scene, truth = searched("car")
    seen, found = ~truth, ~scene
    assert seen[1].mean() > 0.015
    assert (found & seen)[1].mean() > 0.55 * seen[1].mean()
    assert (found & ~seen).mean(axis=(1, 2)).max() < 0.005


def test_nothing_is_found_where_no_camera_sees_a_body():
    scene, truth = searched("none")
    assert truth.all()
    assert (~scene).mean() == 0.0
