# SPDX-License-Identifier: Apache-2.0
"""`cvcdepth networks`: every network that can be named, for people and for programs."""

import json

import pytest

from cvcdepth_core.networks import NETWORKS
from cvcdepth_ros.bag_replay import main


def test_it_lists_every_network_with_its_size_its_engines_and_what_it_is(capsys: pytest.CaptureFixture[str]):
    assert main(["networks", "--json"]) == 0
    listed = {one["name"]: one for one in json.loads(capsys.readouterr().out)["networks"]}
    assert listed.keys() == NETWORKS.keys()
    assert (listed["per_camera"]["parameters"], listed["vfdepth"]["parameters"]) == (14_327_217, 19_269_233)
    assert not listed["vfdepth"]["independent"]
    assert main(["networks"]) == 0
    text = capsys.readouterr().out
    for name, one in listed.items():
        assert f"{name}: {one['summary']}" in text
        assert ", ".join(one["engines"]) in text
