# SPDX-License-Identifier: Apache-2.0
"""Ages by ROS time are recorded where they mean something."""

import pytest

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.live.stamp_ages import StampAges
from cvcdepth_ros.surround_sets.latencies import StageLatencies


class Node:
    """A node whose ROS time and steady time are set by hand."""

    def __init__(self) -> None:
        self.ros_time, self.steady = 1000.0, 50.0
        self.latencies = StageLatencies()
        self.ages = StampAges(self.latencies, lambda: round(self.ros_time * NANOSECONDS), lambda: self.steady)

    def receive(self, stamp: float, camera: str = "front") -> None:
        self.ages.record("receive", camera, round(stamp * NANOSECONDS))

    @property
    def count(self) -> int:
        found = self.latencies.summaries().get("receive")
        return found.count if found else 0


def test_a_plausible_age_is_recorded():
    node = Node()
    node.receive(999.9)
    assert node.latencies.summaries()["receive"].max_ms == pytest.approx(100.0)
    assert node.ages.unknown == []


@pytest.mark.parametrize(("ros_time", "stamp"), [(1000.0, 1000.5), (1.8e9, 1000.0), (0.0, 1000.0), (0.0, 0.0)])
def test_an_age_by_another_clock_is_not_and_the_stage_is_called_unknown(ros_time: float, stamp: float):
    node = Node()
    node.ros_time = ros_time
    node.receive(stamp)
    assert (node.count, node.ages.unknown) == (0, ["receive"])


def test_where_a_recording_loops_ages_mean_nothing_for_a_second():
    node = Node()
    node.receive(999.9)
    for _ in range(8):  # the clock has not followed yet
        node.receive(990.0)
        node.steady += 0.1
    assert node.count == 1
    node.ros_time, node.steady = 991.0, node.steady + 0.4
    node.receive(990.9)
    assert node.count == 2
    assert node.latencies.summaries()["receive"].max_ms == pytest.approx(100.0)


def test_cameras_that_fire_one_after_the_other_are_no_loop():
    node = Node()
    for stamp in (999.0, 999.1, 999.2):
        node.receive(stamp, "front")
        node.receive(stamp - 0.05, "back")
    assert node.count == 6
