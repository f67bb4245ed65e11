# SPDX-License-Identifier: Apache-2.0
"""`/diagnostics` tells where the ground is for a network that is told it, and warns where nobody says."""

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from simple_worlds import two_cameras

from cvcdepth_ros.node.diagnostics import ground_problem, ground_status


@pytest.mark.parametrize(
    ("height", "base_frame", "level", "words"),
    [
        (-0.3, "base_link", DiagnosticStatus.OK, "-0.30 m in base_link"),
        (0.0, "base_link", DiagnosticStatus.OK, "0.00 m in base_link"),
        (None, "base_footprint", DiagnosticStatus.OK, "0.00 m in base_footprint"),
        (
            None,
            "base_link",
            DiagnosticStatus.WARN,
            "the height of the ground in base_link is not stated: taken for 0 m",
        ),
    ],
    ids=["stated", "stated as 0", "by its name", "nobody says"],
)
def test_the_ground_is_told_and_its_lack_is_a_warning(height: float | None, base_frame: str, level: bytes, words: str):
    layout = two_cameras().model_copy(update={"ground_height": height, "base_frame": base_frame})
    found = ground_status(layout)
    assert (found.level, found.name) == (level, "ground")
    assert words in found.message
    assert bool(ground_problem(layout)) == (level == DiagnosticStatus.WARN)
    assert [value.key for value in found.values] == [f"ground in {base_frame} (m)"]
