# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by the tests with ROS."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from shared_memory import remove_what_nobody_uses

if TYPE_CHECKING:
    from ros_graph import RosGraph


@pytest.fixture(scope="session", autouse=True)
def shared_memory() -> Iterator[None]:
    """Begin and end without the shared memory of nodes that were killed, which fills the machine run by run."""
    remove_what_nobody_uses()
    yield
    remove_what_nobody_uses()


@pytest.fixture
def graph() -> Iterator[RosGraph]:
    """A domain of the test's own."""
    from ros_graph import RosGraph  # not above: pytest reads this file where there is no ROS, too

    graph = RosGraph()
    yield graph
    graph.close()
