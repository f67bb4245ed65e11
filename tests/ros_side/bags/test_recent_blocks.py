# SPDX-License-Identifier: Apache-2.0
"""Blocks that were read last are kept, up to a number of bytes."""

from cvcdepth_ros.bags.recent_blocks import MESSAGE_BYTES, RecentBlocks, StoredMessage


def block(size: int, messages: int = 1) -> list[StoredMessage]:
    return [StoredMessage(0, number, b"x" * (size // messages - MESSAGE_BYTES)) for number in range(messages)]


def test_what_was_not_used_for_longest_makes_room():
    recent = RecentBlocks(3000)
    first, second, third = block(1000), block(1000, 2), block(1500)
    recent.put("first", first)
    recent.put("second", second)
    assert recent.get("first") is first
    recent.put("third", third)
    assert recent.get("second") is None
    assert recent.get("first") is first
    assert recent.get("third") is third


def test_a_block_that_is_too_large_is_not_kept_and_leaves_room():
    recent = RecentBlocks(3000)
    recent.put("huge", block(3001))
    assert recent.get("huge") is None
    fitting = block(3000)
    recent.put("fitting", fitting)
    assert recent.get("fitting") is fitting


def test_a_block_that_is_put_twice_counts_once():
    recent = RecentBlocks(2000)
    other = block(1000)
    recent.put("other", other)
    for _ in range(3):
        recent.put("same", block(1000))
    assert recent.get("other") is other
