# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy grants the running node what it has, and nothing else."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import pytest
from repository import ROOT

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_scene import running_scene
from ros_graph import RosGraph

POLICY = ROOT / "security" / "policies" / "surround_depth.policy.xml"
ONLY_SOMETIMES = {"/clock", "/tf", "/tf_static"}


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosGraph]:
    with running_scene(tmp_path_factory.mktemp("rig")) as scene:
        yield scene.graph


def granted(kind: str, how: str, item: str) -> set[str]:
    profile = ElementTree.parse(POLICY).getroot().find("./enclaves/enclave/profiles/profile")
    assert profile is not None
    assert (profile.get("ns"), profile.get("node")) == ("/", "surround_depth")
    return {
        str(entry.text) for block in profile.findall(kind) if block.get(how) == "ALLOW" for entry in block.findall(item)
    }


def test_the_policy_allows_exactly_what_the_node_has(graph):
    subscribed = {name for name, _ in graph.node.get_subscriber_names_and_types_by_node("surround_depth", "/")}
    published = {name for name, _ in graph.node.get_publisher_names_and_types_by_node("surround_depth", "/")}
    served = {name for name, _ in graph.node.get_service_names_and_types_by_node("surround_depth", "/")}
    assert granted("topics", "subscribe", "topic") - ONLY_SOMETIMES == subscribed - ONLY_SOMETIMES
    assert granted("topics", "publish", "topic") - ONLY_SOMETIMES == published - ONLY_SOMETIMES
    assert granted("services", "reply", "service") == served
    assert not graph.node.get_client_names_and_types_by_node("surround_depth", "/")
