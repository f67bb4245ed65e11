# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by the tests with ROS."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from ros_graph import RosGraph


@pytest.fixture
def graph() -> Iterator[RosGraph]:
    """A domain of the test's own."""
    from ros_graph import RosGraph  # not above: pytest reads this file where there is no ROS, too

    graph = RosGraph()
    yield graph
    graph.close()
