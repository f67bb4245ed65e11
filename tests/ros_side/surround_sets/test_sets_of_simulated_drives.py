# SPDX-License-Identifier: Apache-2.0
"""The synchroniser finds the sets that a simulated drive was made of, however its cameras fire and images get lost."""

import random

import pytest

from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.worlds.description import WorldSpec
from cvcdepth_core.worlds.drive import DriveSpec
from cvcdepth_core.worlds.sensors import Sensors
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.simulation.choices import KNOWN_RIGS, chosen_layout
from cvcdepth_ros.simulation.set_messages import stamp_of
from cvcdepth_ros.surround_sets.synchronizer import SurroundSynchronizer

SETS = 30


def images(rig: str, stagger: float, rate: float) -> tuple[RigLayout, list[tuple[int, str, int]]]:
    """Stamp, camera and number of the set of every image, in the order of arrival: up to 30 ms after the exposure."""
    layout = chosen_layout(rig, (64, 40), 0)
    spec = DriveSpec(layout=layout, world=WorldSpec(), sensors=Sensors(rate=rate, stagger=stagger), seconds=SETS / rate)
    late = random.Random(1)
    taken = [
        (stamp_of(spec.camera_time(camera, number)), camera.name, number)
        for camera in layout.complete().cameras
        for number in range(spec.sets)
    ]
    return layout, sorted(taken, key=lambda image: image[0] + late.randrange(30_000_000))


def found(layout: RigLayout, arriving: list[tuple[int, str, int]], rate: float) -> list[dict[str, int]]:
    """The numbers of each set's images, by camera."""
    synchroniser: SurroundSynchronizer[int] = SurroundSynchronizer(
        layout.names, layout.anchor_camera, max(MatchingSettings().tolerance, 1 / rate)
    )
    sets = [each for stamp, camera, number in arriving for each in synchroniser.add(camera, stamp, number)]
    return [each.images for each in sets + synchroniser.flush()]


@pytest.mark.parametrize("rate", [5.0, 10.0, 30.0])
@pytest.mark.parametrize("stagger", [0.0, 0.6, 0.9])
@pytest.mark.parametrize("rig", KNOWN_RIGS)
def test_every_set_is_made_of_the_images_of_one_set(rig: str, stagger: float, rate: float):
    layout, arriving = images(rig, stagger, rate)
    assert found(layout, arriving, rate) == [dict.fromkeys(layout.names, number) for number in range(SETS)]


@pytest.mark.parametrize("stagger", [0.0, 0.6, 0.9])
def test_a_lost_image_costs_its_own_set_and_no_other(stagger: float):
    layout, arriving = images("nuscenes", stagger, 10.0)
    chance = random.Random(5)
    lost = {(chance.choice(layout.names), number) for number in (3, 9, 17, 19, 26)}
    left = [image for image in arriving if (image[1], image[2]) not in lost]
    whole = [number for number in range(SETS) if number not in {number for _, number in lost}]
    assert found(layout, left, 10.0) == [dict.fromkeys(layout.names, number) for number in whole]
