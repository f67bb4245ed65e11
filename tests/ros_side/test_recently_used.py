# SPDX-License-Identifier: Apache-2.0
"""Values that were used last are kept, up to a number of bytes."""

from cvcdepth_ros.recently_used import RecentlyUsed


def test_what_was_not_used_for_longest_makes_room():
    kept: RecentlyUsed[str, int] = RecentlyUsed(10)
    for key in ("a", "b"):
        kept.put(key, ord(key), 5)
    assert kept.get("a") == ord("a")
    kept.put("c", 3, 5)
    assert [kept.get(key) for key in "abc"] == [ord("a"), None, 3]


def test_a_value_that_takes_the_place_of_another_counts_alone():
    kept: RecentlyUsed[str, int] = RecentlyUsed(10)
    kept.put("other", 0, 5)
    for number in range(3):
        kept.put("same", number, 5)
    assert (kept.get("other"), kept.get("same")) == (0, 2)


def test_without_room_nothing_is_kept():
    kept: RecentlyUsed[str, int] = RecentlyUsed(0)
    kept.put("a", 1, 1)
    assert kept.get("a") is None
