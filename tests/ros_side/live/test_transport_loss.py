# SPDX-License-Identifier: Apache-2.0
"""Images that DDS loses are told while they are being lost."""

from cvcdepth_ros.live.transport_loss import TransportLoss


def test_losses_are_told_with_their_cameras_while_they_go_on_and_no_longer():
    now = 0.0
    loss = TransportLoss(lambda: now)
    assert loss.update({"left": 0, "right": 0}) == ""
    told = loss.update({"left": 3, "right": 0})
    assert "(left 3)" in told
    assert "reliable:=true" in told
    now = 4.0
    assert loss.update({"left": 3, "right": 0}) != ""
    now = 6.0
    assert loss.update({"left": 3, "right": 0}) == ""
    assert "(left 3, right 1)" in loss.update({"left": 3, "right": 1})
