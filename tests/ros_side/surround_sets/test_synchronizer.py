# SPDX-License-Identifier: Apache-2.0
"""The synchroniser against real stamps, a brute-force oracle and random faults; the mailbox behind it."""

import itertools
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from repository import ROOT
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cvcdepth_core.errors import ConfigError
from cvcdepth_ros.live.mailbox import Mailbox
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet, SurroundSynchronizer

MS = 1_000_000
PERIOD = 100 * MS
PANDASET = ("front", "front_left", "left", "back", "right", "front_right")

Arrival = tuple[str, int]  # camera, stamp [ns]


# --- real recordings ------------------------------------------------------------------------------------------------


def recorded_arrivals(name: str) -> list[Arrival]:
    folders = [ROOT / "samples" / name, ROOT.parent / "shared" / "data" / name]
    folder = next((f for f in folders if f.is_dir()), None)
    if folder is None:
        pytest.skip(f"recording {name} is in none of {', '.join(map(str, folders))}")
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        images = [c for c in reader.connections if c.msgtype == "sensor_msgs/msg/CompressedImage"]
        arrivals = []
        for connection, _, raw in reader.messages(connections=images):
            stamp = reader.deserialize(raw, connection.msgtype).header.stamp
            arrivals.append((connection.topic.split("/")[2], stamp.sec * 10**9 + stamp.nanosec))
    return arrivals


@pytest.fixture(scope="module")
def excerpt() -> list[Arrival]:
    return recorded_arrivals("pandaset_002_excerpt")


def pandaset_synchronizer(tolerance: float = 0.09) -> SurroundSynchronizer[Arrival]:
    return SurroundSynchronizer(PANDASET, "front", tolerance)


def feed(synchronizer: SurroundSynchronizer, arrivals: Iterable[Arrival], *, flush: bool = True) -> list[SurroundSet]:
    sets = [s for camera, stamp in arrivals for s in synchronizer.add(camera, stamp, (camera, stamp))]
    return sets + (synchronizer.flush() if flush else [])


@pytest.mark.parametrize(("name", "count"), [("pandaset_002_excerpt", 10), ("pandaset_002", 40)])
def test_the_staggered_cameras_of_the_sample_give_every_set(name: str, count: int):
    arrivals = recorded_arrivals(name)
    synchronizer = pandaset_synchronizer()
    sets = feed(synchronizer, arrivals)
    cycles = [dict(arrivals[i : i + 6]) for i in range(0, len(arrivals), 6)]
    assert [s.stamps_ns for s in sets] == cycles
    assert len(sets) == count
    assert all(s.stamp_ns == s.stamps_ns["front"] and 80 * MS < s.spread_ns < 82 * MS for s in sets)
    assert all(c.matched == c.received == count and not c.dropped for c in synchronizer.statistics().cameras.values())


def test_a_set_leaves_with_its_last_image_once_the_periods_are_known(excerpt: list[Arrival]):
    synchronizer = pandaset_synchronizer()
    leaving = [camera for camera, stamp in excerpt if synchronizer.add(camera, stamp, None)]
    assert leaving == ["front", *["right"] * 9]  # the first set waits for a second anchor image


def test_a_tolerance_below_the_stagger_gives_no_set_and_counts_why(excerpt: list[Arrival]):
    synchronizer = pandaset_synchronizer(tolerance=0.05)
    assert feed(synchronizer, excerpt) == []
    assert synchronizer.statistics().cameras["front"].dropped == {"unmatched": 10}


def test_offsets_that_undo_the_stagger_allow_a_small_tolerance(excerpt: list[Arrival]):
    front = dict(excerpt[:6])["front"]
    offsets = {camera: (stamp - front) / 1e9 for camera, stamp in excerpt[:6]}
    synchronizer = SurroundSynchronizer(PANDASET, "front", 0.001, offsets)
    sets = feed(synchronizer, excerpt)
    assert len(sets) == 10
    assert [s.stamps_ns for s in sets] == [dict(excerpt[i : i + 6]) for i in range(0, 60, 6)]
    assert max(s.spread_ns for s in sets) < MS


@pytest.mark.parametrize("missed", range(12))
def test_a_start_in_mid_cycle_finds_the_phase_of_the_nearest_images(excerpt: list[Arrival], missed: int):
    sets = feed(pandaset_synchronizer(), excerpt[missed:])
    complete = (60 - missed) // 6
    assert len(sets) >= complete - 1
    farthest = max(abs(stamp - s.stamp_ns) for s in sets for stamp in s.stamps_ns.values())
    assert farthest < 0.51 * PERIOD  # back is half a period away in either phase


@pytest.mark.parametrize("lost", range(12, 18))
def test_one_lost_image_costs_one_set_and_no_later_phase(excerpt: list[Arrival], lost: int):
    sets = feed(pandaset_synchronizer(), excerpt[:lost] + excerpt[lost + 1 :])
    assert len(sets) == 9
    assert max(abs(stamp - s.stamp_ns) for s in sets for stamp in s.stamps_ns.values()) < 0.51 * PERIOD


def test_a_short_recording_that_loops_goes_on_in_every_round(excerpt: list[Arrival]):
    synchronizer = pandaset_synchronizer()  # the loop steps back by less than clock_jump
    rounds = [feed(synchronizer, excerpt, flush=False) for _ in range(4)]
    rounds.append(synchronizer.flush())  # the last set may wait for a nearer image
    assert sum(map(len, rounds)) == 40
    assert [s.stamp_ns for sets in rounds for s in sets] == 4 * [
        stamp for camera, stamp in excerpt if camera == "front"
    ]
    assert all(c.clock_steps == 3 and not c.dropped for c in synchronizer.statistics().cameras.values())


# --- random streams -------------------------------------------------------------------------------------------------


@dataclass
class Streams:
    """Cameras that fire once a period; `arrivals` are in the order in which they reach the synchroniser."""

    cameras: tuple[str, ...]
    period: int
    offsets: dict[str, float]
    arrivals: list[Arrival]
    cycle_of: dict[Arrival, int] = field(default_factory=dict)

    @property
    def anchor(self) -> str:
        return self.cameras[0]

    def corrected(self, camera: str, stamp: int) -> int:
        return stamp - round(self.offsets[camera] * 1e9)


@st.composite
def streams(draw: st.DrawFn, cycles: int = 30, jitter: float = 0.0, stagger: float = 0.0) -> Streams:
    """Perfect streams: jitter and stagger are fractions of a period, either side."""
    cameras = tuple(f"camera{i}" for i in range(draw(st.integers(2, 5))))
    period = draw(st.sampled_from([16_666_667, 33_333_333, PERIOD]))
    rng = random.Random(draw(st.integers(0, 2**32)))
    offsets = {c: rng.choice([0.0, rng.uniform(-0.2, 0.2)]) for c in cameras}
    phases = {c: rng.uniform(-stagger, stagger) * period for c in cameras}
    phases[cameras[0]] = 0.0
    timed, cycle_of = [], {}
    for cycle, camera in itertools.product(range(cycles), cameras):
        moment = round((10 + cycle + rng.uniform(-jitter, jitter)) * period + phases[camera])
        arrival = (camera, moment + round(offsets[camera] * 1e9))
        timed.append((moment, arrival))
        cycle_of[arrival] = cycle
    return Streams(cameras, period, offsets, [arrival for _, arrival in sorted(timed)], cycle_of)


def disturb(s: Streams, rng: random.Random, drop: float = 0.1, duplicate: float = 0.1, swap: float = 0.1) -> None:
    """Lose, double and swap arrivals; neighbours of the whole stream and of one camera change places."""
    kept = [a for a in s.arrivals if rng.random() >= drop]
    s.arrivals = [a for a in kept for _ in range(1 + (rng.random() < duplicate))]
    for distance in (1, len(s.cameras)):
        for i in range(len(s.arrivals) - distance):
            if rng.random() < swap:
                s.arrivals[i], s.arrivals[i + distance] = s.arrivals[i + distance], s.arrivals[i]


def step_clock(s: Streams, rng: random.Random, cameras: Iterable[str], seconds: float) -> None:
    """From a random moment on the stamps of some cameras are off."""
    moment = rng.randrange(len(s.arrivals))
    step = {c: round(seconds * 1e9) for c in cameras}
    s.arrivals[moment:] = [(c, stamp + step.get(c, 0)) for c, stamp in s.arrivals[moment:]]


def synchronizer_for(s: Streams, tolerance: float, queue_size: int = 10) -> SurroundSynchronizer:
    """Tolerance as a fraction of the period."""
    return SurroundSynchronizer(s.cameras, s.anchor, tolerance * s.period / 1e9, s.offsets, queue_size)


def cycles_of(s: Streams, sets: Iterable[SurroundSet]) -> list[set[int]]:
    return [{s.cycle_of[image] for image in surround_set.images.values()} for surround_set in sets]


@settings(max_examples=150, deadline=None)
@given(streams(stagger=0.6, jitter=0.3), st.integers(0, 2**32), st.floats(0.1, 1.5), st.integers(2, 12))
def test_whatever_comes_in_the_sets_keep_their_promises(s: Streams, seed: int, tolerance: float, queue_size: int):
    rng = random.Random(seed)
    disturb(s, rng)
    for _ in range(rng.randrange(4)):
        step_clock(s, rng, rng.sample(s.cameras, rng.randint(1, len(s.cameras))), rng.uniform(-3, 3))
    synchronizer = synchronizer_for(s, tolerance, queue_size)
    used: set[int] = set()
    last = dict.fromkeys(s.cameras, -(2**62))
    backward = dict.fromkeys(s.cameras, 0)
    for number, (camera, stamp) in enumerate(s.arrivals):
        sets = synchronizer.add(camera, stamp, number)
        statistics = synchronizer.statistics()
        for of_camera in statistics.cameras.values():
            assert of_camera.queued <= queue_size
            assert of_camera.received == of_camera.matched + of_camera.queued + sum(of_camera.dropped.values())
        for surround_set in sets:
            corrected = [s.corrected(c, stamp) for c, stamp in surround_set.stamps_ns.items()]
            assert [*surround_set.times_ns.values()] == corrected
            assert surround_set.time_ns == s.corrected(surround_set.anchor, surround_set.stamp_ns)
            assert surround_set.spread_ns == max(corrected) - min(corrected) <= round(tolerance * s.period) + 1
            assert [s.arrivals[surround_set.images[c]] for c in s.cameras] == list(surround_set.stamps_ns.items())
            assert used.isdisjoint(surround_set.images.values())
            used.update(surround_set.images.values())
            for c in s.cameras:
                backward[c] += surround_set.stamps_ns[c] <= last[c]
                last[c] = surround_set.stamps_ns[c]
                assert backward[c] <= statistics.cameras[c].clock_steps  # increasing unless the camera's clock stepped
    matched = [c.matched for c in synchronizer.statistics().cameras.values()]
    assert sum(matched) == len(used)


def brute_force_best(s: Streams, came: dict[str, list[int]], used: dict[str, int], anchor: int, tolerance: int):
    """The cheapest of all combinations of unused images around the anchor; a later image costs 1.25 times."""
    following = min((stamp for stamp in came[s.anchor] if stamp > anchor), default=None)
    candidates = []
    for camera in s.cameras[1:]:
        unused = {stamp for stamp in came[camera] if stamp > used[camera] and abs(stamp - anchor) <= tolerance}
        candidates.append([u for u in unused if following is None or abs(u - anchor) < abs(following - u)])
    cost = {True: 1.25, False: 1.0}
    combinations = itertools.product(*candidates)
    return min(combinations, key=lambda c: sum(abs(u - anchor) * cost[u > anchor] for u in c), default=None)


@settings(max_examples=150, deadline=None)
@given(streams(stagger=0.6, jitter=0.3, cycles=20), st.integers(0, 2**32), st.floats(0.3, 2.0))
def test_every_set_is_the_best_match_among_the_images_that_had_come(s: Streams, seed: int, tolerance: float):
    disturb(s, random.Random(seed))
    synchronizer = synchronizer_for(s, tolerance, queue_size=100)
    came: dict[str, list[int]] = {c: [] for c in s.cameras}
    used = dict.fromkeys(s.cameras, -(2**62))
    for camera, stamp in s.arrivals:
        came[camera].append(s.corrected(camera, stamp))
        sets = synchronizer.add(camera, stamp, None)
        assume(not any(c.clock_steps for c in synchronizer.statistics().cameras.values()))
        for surround_set in sets:
            chosen = {c: s.corrected(c, stamp) for c, stamp in surround_set.stamps_ns.items()}
            anchor = chosen[s.anchor]
            best = brute_force_best(s, came, used, anchor, round(tolerance * s.period) + 1)
            assert tuple(chosen[c] for c in s.cameras[1:]) == best
            used = chosen


@settings(max_examples=60, deadline=None)
@given(streams(jitter=0.249), st.floats(0.5, 0.95))
def test_perfect_streams_with_jitter_below_a_quarter_period_give_every_set(s: Streams, tolerance: float):
    assert cycles_of(s, feed(synchronizer_for(s, tolerance), s.arrivals)) == [{cycle} for cycle in range(30)]


@settings(max_examples=60, deadline=None)
@given(streams(jitter=0.2), st.integers(0, 2**32), st.floats(0.4, 0.6))
def test_lost_and_doubled_images_cost_only_the_sets_they_are_in(s: Streams, seed: int, tolerance: float):
    disturb(s, random.Random(seed), swap=0.0)
    complete = [
        {cycle}
        for cycle, count in sorted(Counter(s.cycle_of[a] for a in set(s.arrivals)).items())
        if count == len(s.cameras)
    ]
    assert cycles_of(s, feed(synchronizer_for(s, tolerance), s.arrivals)) == complete


@settings(max_examples=60, deadline=None)
@given(streams(stagger=0.5, jitter=0.01), st.integers(0, 20))
def test_a_start_anywhere_in_the_cycle_settles_on_the_nearest_images(s: Streams, missed: int):
    sets = feed(synchronizer_for(s, 1.2), s.arrivals[missed:])
    assert len(sets) >= 30 - missed // len(s.cameras) - 3
    for surround_set in sets[2:]:
        anchor = s.corrected(s.anchor, surround_set.stamp_ns)
        distances = [abs(s.corrected(c, stamp) - anchor) for c, stamp in surround_set.stamps_ns.items()]
        assert max(distances) < 0.6 * s.period


def fault_dead_camera(s: Streams, rng: random.Random) -> None:
    dead = rng.choice(s.cameras)
    s.arrivals = [a for a in s.arrivals if a[0] != dead or not 10 <= s.cycle_of[a] < 20]


def fault_wrong_stamps(s: Streams, rng: random.Random) -> None:
    wrong, off = rng.choice(s.cameras), rng.choice([-3600, -2, 2, 3600]) * 10**9
    s.arrivals = [(c, t + off) if c == wrong and 10 <= s.cycle_of[c, t] < 20 else (c, t) for c, t in s.arrivals]


def fault_small_step_ahead(s: Streams, rng: random.Random) -> None:
    wrong, off = rng.choice(s.cameras), round(rng.uniform(1.2, 8) * s.period)
    s.arrivals = [(c, t + off) if c == wrong and s.cycle_of[c, t] == 19 else (c, t) for c, t in s.arrivals]


def fault_burst_of_old_images(s: Streams, rng: random.Random) -> None:
    start = s.arrivals.index(next(a for a in s.arrivals if s.cycle_of[a] == 20))
    again = [a for a in s.arrivals if s.cycle_of[a] in (5, 6)]
    s.arrivals[start:start] = rng.sample(again, len(again))


@pytest.mark.parametrize(
    "fault", [fault_dead_camera, fault_wrong_stamps, fault_small_step_ahead, fault_burst_of_old_images]
)
@settings(max_examples=40, deadline=None)
@given(s=streams(jitter=0.1, stagger=0.1), seed=st.integers(0, 2**32))
def test_the_stream_recovers_within_five_periods_of_a_fault(
    fault: Callable[[Streams, random.Random], None], s: Streams, seed: int
):
    fault(s, random.Random(seed))
    seen = {image for x in feed(synchronizer_for(s, 0.45), s.arrivals) for image in x.images.values()}
    late = {arrival for arrival, cycle in s.cycle_of.items() if cycle >= 25}
    assert late <= seen


@settings(max_examples=60, deadline=None)
@given(streams(jitter=0.1, stagger=0.1), st.floats(-5, 5))
def test_a_step_of_all_clocks_costs_a_few_sets_only(s: Streams, seconds: float):
    step = round(seconds * 1e9)
    stepped = [(c, t + step) if s.cycle_of[c, t] >= 10 else (c, t) for c, t in s.arrivals]
    synchronizer = synchronizer_for(s, 0.45)
    sets = feed(synchronizer, stepped)
    after = [x for x in sets if x.stamps_ns == dict(stepped[-len(s.cameras) :])]
    assert len(after) == 1
    assert len(sets) >= 30 - 5


# --- single behaviours ----------------------------------------------------------------------------------------------


def pair(tolerance: float = 0.03, **options: Any) -> SurroundSynchronizer[str]:
    return SurroundSynchronizer(["a", "b"], "a", tolerance, **options)


def add_all(synchronizer: SurroundSynchronizer, *arrivals: tuple[str, int]) -> list[dict[str, int]]:
    """Stamps in milliseconds, in and out."""
    sets = [s for camera, ms in arrivals for s in synchronizer.add(camera, ms * MS, f"{camera}{ms}")]
    return [{c: stamp // MS for c, stamp in s.stamps_ns.items()} for s in sets]


def test_a_set_carries_its_images_stamps_and_spread():
    synchronizer = pair(offsets={"b": 0.005})
    [first] = [s for c, ms in [("a", 100), ("b", 110)] for s in synchronizer.add(c, ms * MS, c)] + synchronizer.flush()
    assert (first.sequence, first.stamp_ns, first.spread_ns) == (0, 100 * MS, 5 * MS)
    assert first.stamps_ns == {"a": 100 * MS, "b": 110 * MS}
    assert list(first.images.items()) == [("a", "a"), ("b", "b")]


def test_the_nearest_of_several_images_is_used_and_the_older_are_counted_as_unmatched():
    synchronizer = pair()
    assert add_all(synchronizer, ("b", 80), ("b", 90), ("b", 98), ("b", 108), ("a", 100)) == [{"a": 100, "b": 98}]
    assert synchronizer.statistics().cameras["b"].dropped == {"unmatched": 2}


def test_an_image_that_arrives_late_but_before_the_decision_is_used():
    assert add_all(pair(), ("b", 99), ("b", 119), ("b", 109), ("a", 110), ("a", 210)) == [{"a": 110, "b": 109}]


def test_an_image_older_than_a_used_one_is_out_of_order():
    synchronizer = pair()
    add_all(synchronizer, ("a", 100), ("b", 100), ("a", 200), ("b", 200), ("a", 150), ("b", 150))
    cameras = synchronizer.statistics().cameras
    assert cameras["a"].dropped == cameras["b"].dropped == {"out_of_order": 1}


def test_a_repeated_stamp_is_dropped_whether_its_image_is_queued_or_used():
    synchronizer = pair()
    add_all(synchronizer, ("a", 100), ("a", 100), ("b", 100), ("a", 200), ("b", 200), ("a", 200), ("b", 200))
    cameras = synchronizer.statistics().cameras
    assert cameras["a"].dropped == {"duplicate_stamp": 2}
    assert cameras["b"].dropped == {"duplicate_stamp": 1}
    assert synchronizer.statistics().sets == 2


def test_a_camera_that_never_stamps_does_not_count_as_a_clock_step():
    synchronizer = pair()
    add_all(synchronizer, *[("b", 0)] * 20)
    assert synchronizer.statistics().cameras["b"].dropped == {"duplicate_stamp": 19}
    assert synchronizer.statistics().cameras["b"].clock_steps == 0


def test_a_dead_camera_leaves_bounded_queues():
    synchronizer = pair(queue_size=4)
    assert add_all(synchronizer, *[("a", 100 * i) for i in range(50)]) == []
    a = synchronizer.statistics().cameras["a"]
    assert (a.received, a.queued, a.dropped) == (50, 4, {"queue_full": 46})
    assert add_all(synchronizer, ("b", 4900), ("a", 5000)) == [{"a": 4900, "b": 4900}]


def test_a_clock_that_steps_back_starts_its_camera_anew_and_counts_it():
    synchronizer = pair()
    add_all(synchronizer, *[(c, 10_000 + 100 * i) for i in range(5) for c in "ab"], ("b", 10_500), ("b", 0))
    assert synchronizer.statistics().cameras["b"].clock_steps == 1
    assert add_all(synchronizer, ("a", 0), ("a", 100), ("b", 100), ("a", 200))[0] == {"a": 0, "b": 0}
    assert [c.dropped for c in synchronizer.statistics().cameras.values()] == [{}, {"clock_jump": 1}]


def test_images_from_before_a_step_that_come_after_another_cameras_step_still_make_their_set():
    synchronizer = pair()
    add_all(synchronizer, *[(c, 10_000 + 100 * i) for i in range(5) for c in "ab"], ("b", 10_510), ("b", 10))
    assert add_all(synchronizer, ("a", 10_500), ("a", 0), ("a", 100)) == [{"a": 10_500, "b": 10_510}, {"a": 0, "b": 10}]


def test_a_camera_whose_clock_alone_steps_back_is_waited_with_for_two_periods_only():
    synchronizer = pair(min_cameras=1)
    add_all(synchronizer, *[(c, 10_000 + 100 * i) for i in range(5) for c in "ab"])
    sets = add_all(synchronizer, *[(c, t + 100 * i) for i in range(8) for c, t in (("a", 10_500), ("b", 0))])
    assert {s["a"] for s in sets} >= {10_500 + 100 * i for i in range(4)}
    assert synchronizer.statistics().cameras["b"].queued <= 8


@settings(max_examples=60, deadline=None)
@given(streams(jitter=0.05, stagger=0.2), st.integers(0, 2**32))
def test_a_recording_that_loops_loses_nothing_also_where_images_change_places_at_the_jump(s: Streams, seed: int):
    arrivals, rng = s.arrivals * 3, random.Random(seed)
    for jump in (len(s.arrivals), 2 * len(s.arrivals)):
        i = jump + rng.randrange(-2, 2)
        if arrivals[i][0] != arrivals[i + 1][0]:
            arrivals[i], arrivals[i + 1] = arrivals[i + 1], arrivals[i]
    synchronizer = synchronizer_for(s, 0.7)
    assert cycles_of(s, feed(synchronizer, arrivals)) == 3 * [{cycle} for cycle in range(30)]
    assert all(camera.clock_steps == 2 for camera in synchronizer.statistics().cameras.values())


def test_a_step_back_below_the_bound_is_known_by_three_images_that_ascend_behind_the_newest():
    synchronizer = pair()
    add_all(synchronizer, *[(c, 1000 + 100 * i) for i in range(5) for c in "ab"])
    sets = add_all(synchronizer, *[(c, 950 + 100 * i) for i in range(5) for c in "ab"])
    assert [s["a"] for s in sets] == [1150, 1250, 1350]
    assert [c.clock_steps for c in synchronizer.statistics().cameras.values()] == [1, 1]


def test_late_images_that_do_not_ascend_are_no_clock_step():
    synchronizer = pair()
    add_all(synchronizer, ("b", 400), ("b", 300), ("b", 200), ("b", 100))
    b = synchronizer.statistics().cameras["b"]
    assert (b.queued, b.clock_steps) == (4, 0)


def test_cameras_too_far_apart_are_counted_as_unmatched_and_not_hoarded():
    synchronizer = pair()
    assert (
        add_all(synchronizer, *[arrival for i in range(20) for arrival in [("a", 100 * i), ("b", 100 * i + 50)]]) == []
    )
    b = synchronizer.statistics().cameras["b"]
    assert (b.queued, b.dropped) == (1, {"unmatched": 19})


def test_a_pause_does_not_spoil_the_period_that_decides_whether_to_wait():
    synchronizer = pair()
    assert add_all(synchronizer, *[("b", ms) for ms in (0, 30, 60, 90, 1090, 1120)], ("a", 1140)) == []
    assert add_all(synchronizer, ("b", 1150), ("a", 1240)) == [{"a": 1140, "b": 1150}]


def test_flush_decides_the_last_anchor_and_the_next_recording_starts_anew():
    synchronizer = pair()
    assert add_all(synchronizer, ("a", 5000), ("b", 5010)) == []
    assert [s.stamp_ns for s in synchronizer.flush()] == [5000 * MS]
    assert synchronizer.flush() == []
    assert add_all(synchronizer, ("b", 1000), ("a", 1000), ("b", 1100)) == [{"a": 1000, "b": 1000}]
    assert [s.sequence for s in [*synchronizer.add("a", 1100 * MS, ""), *synchronizer.flush()]] == [2]


def test_flush_counts_what_no_set_could_use():
    synchronizer = pair()
    add_all(synchronizer, ("a", 100), ("b", 180), ("b", 280))
    assert synchronizer.flush() == []
    cameras = synchronizer.statistics().cameras
    assert (cameras["a"].dropped, cameras["b"].dropped) == ({"unmatched": 1}, {"unmatched": 2})


def test_a_faster_camera_gives_its_nearest_image_without_waiting_for_the_next():
    synchronizer = pair()
    sets = add_all(synchronizer, *sorted([("b", 30 * i) for i in range(12)] + [("a", 95)], key=lambda x: x[1]))
    sets += add_all(synchronizer, ("a", 335))
    assert sets == [{"a": 95, "b": 90}, {"a": 335, "b": 330}]


@pytest.fixture
def eager_thread_switches():
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("eager_thread_switches")
def test_two_threads_lose_nothing():
    cycles = 2000
    synchronizer = SurroundSynchronizer(list("abcd"), "a", 0.01, queue_size=cycles)
    sets: list[SurroundSet] = []
    start = threading.Barrier(2)

    def camera_pair(cameras: str) -> None:
        start.wait()
        for cycle in range(cycles):
            for camera in cameras:
                sets.extend(synchronizer.add(camera, cycle * 100 * MS, (camera, cycle)))

    threads = [threading.Thread(target=camera_pair, args=[cameras]) for cameras in ("ab", "cd")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sets.extend(synchronizer.flush())
    sets.sort(key=lambda s: s.sequence)
    assert [s.sequence for s in sets] == list(range(cycles))
    assert [s.images for s in sets] == [{c: (c, cycle) for c in "abcd"} for cycle in range(cycles)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": []}, r"cameras: expected at least one name, all of them different, found \[\]"),
        ({"cameras": ["a", "a"]}, r"cameras: expected at least one name, all of them different"),
        ({"cameras": "ab"}, r"cameras: expected at least one name, all of them different, found 'ab'"),
        ({"anchor": "c"}, "anchor: 'c' is not one of a, b"),
        ({"tolerance": -0.1}, r"tolerance: expected a number of seconds of at least 0.0, found -0.1"),
        ({"tolerance": float("nan")}, "tolerance: .* found nan"),
        ({"tolerance": "0.1"}, "tolerance: .* found '0.1'"),
        ({"offsets": {"c": 0.0}}, "offsets: c not among the cameras a, b"),
        ({"offsets": {"b": float("inf")}}, r"offsets\['b'\]: .* found inf"),
        ({"queue_size": 1}, "queue_size: .* at least 2 images, found 1"),
        ({"queue_size": 2.5}, "queue_size: .* found 2.5"),
        ({"clock_jump": 0.0}, "clock_jump: .* at least 0.1, found 0.0"),
    ],
)
def test_a_bad_setting_is_named_with_its_value(change: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        SurroundSynchronizer(**{"cameras": ["a", "b"], "anchor": "a", "tolerance": 0.1, **change})


def test_an_image_of_an_unknown_camera_is_refused_by_name():
    with pytest.raises(ConfigError, match="camera: 'c' is not one of a, b"):
        pair().add("c", 0, "")


# --- mailbox --------------------------------------------------------------------------------------------------------


def numbered_set(sequence: int, time_ns: int = 0) -> SurroundSet[str]:
    """A set whose anchor's clock is an hour ahead, as its rig file knows."""
    return SurroundSet(sequence, "front", time_ns + 36_000 * PERIOD, {}, {"front": time_ns}, {}, 0)


def test_the_newest_set_wins_and_the_replaced_one_is_counted():
    mailbox: Mailbox[str] = Mailbox()
    assert mailbox.put(numbered_set(0))
    assert mailbox.put(numbered_set(1))
    assert mailbox.get() == numbered_set(1)
    assert mailbox.get(timeout=0) is None
    statistics = mailbox.statistics()
    assert (statistics.received, statistics.delivered, statistics.replaced) == (2, 1, 1)


def test_a_set_handed_over_after_a_newer_one_is_not_stored():
    mailbox: Mailbox[str] = Mailbox()
    mailbox.put(numbered_set(1))
    assert not mailbox.put(numbered_set(0))
    assert mailbox.get() == numbered_set(1)
    assert not mailbox.put(numbered_set(0))
    assert mailbox.get(timeout=0) is None
    assert mailbox.statistics().replaced == 2


def test_a_set_older_than_the_freshness_gate_is_dropped_when_it_is_read():
    now = [10_000 * MS]
    mailbox: Mailbox[str] = Mailbox(max_age=0.5, clock=lambda: now[0])
    mailbox.put(numbered_set(0, time_ns=9_500 * MS))
    assert mailbox.get(timeout=0) == numbered_set(0, time_ns=9_500 * MS)
    mailbox.put(numbered_set(1, time_ns=9_900 * MS))
    now[0] = 10_401 * MS
    assert mailbox.get(timeout=0) is None
    assert (mailbox.statistics().delivered, mailbox.statistics().stale) == (1, 1)


def taken(mailbox: Mailbox[str], sequence: int, time_ns: int) -> bool:
    mailbox.put(numbered_set(sequence, time_ns=time_ns))
    return mailbox.get(timeout=0) is not None


def test_where_a_recording_loops_sets_of_the_new_round_are_taken_before_the_clock_has_gone_back():
    now = [10_000 * MS]
    mailbox: Mailbox[str] = Mailbox(max_age=0.5, clock=lambda: now[0])
    assert taken(mailbox, 0, 9_900 * MS)
    assert taken(mailbox, 1, 0)  # the clock has not followed
    assert taken(mailbox, 2, 100 * MS)
    now[0] = 200 * MS
    assert taken(mailbox, 3, 150 * MS)
    now[0] = 1_000 * MS
    assert not taken(mailbox, 4, 200 * MS)


def test_a_clock_that_does_not_follow_the_jump_or_never_was_the_recordings_makes_no_set_fresh():
    now = [10_000 * MS]
    mailbox: Mailbox[str] = Mailbox(max_age=0.5, clock=lambda: now[0])
    assert taken(mailbox, 0, 9_900 * MS)
    assert taken(mailbox, 1, 0)
    now[0] += 1_000 * MS
    assert not taken(mailbox, 2, 1_000 * MS)
    years = 10**18
    mailbox = Mailbox(max_age=0.5, clock=lambda: years)
    assert not any(taken(mailbox, i, time_ns * MS) for i, time_ns in enumerate((9_900, 0, 100, 200)))


def test_a_put_wakes_a_waiting_reader():
    mailbox: Mailbox[str] = Mailbox()
    answers: list[object] = []
    reader = threading.Thread(target=lambda: answers.append(mailbox.get()), daemon=True)
    reader.start()
    time.sleep(0.05)  # most likely the reader waits by now; if not, the test passes for a simpler reason
    mailbox.put(numbered_set(0))
    reader.join(timeout=10)
    assert answers == [numbered_set(0)]


def test_close_wakes_a_waiting_reader_and_refuses_later_sets():
    mailbox: Mailbox[str] = Mailbox()
    answers: list[object] = []
    reader = threading.Thread(target=lambda: answers.append(mailbox.get()))
    reader.start()
    mailbox.close()
    reader.join(timeout=10)
    assert answers == [None]
    assert mailbox.closed
    assert not mailbox.put(numbered_set(0))
    assert mailbox.statistics().after_close == 1


def test_a_reader_in_another_thread_sees_sets_in_order_and_each_put_is_accounted_for():
    mailbox: Mailbox[str] = Mailbox()
    seen: list[int] = []

    def read() -> None:
        while (surround_set := mailbox.get()) is not None:
            seen.append(surround_set.sequence)

    reader = threading.Thread(target=read)
    reader.start()
    for sequence in range(500):
        mailbox.put(numbered_set(sequence))
    mailbox.close()
    reader.join(timeout=10)
    statistics = mailbox.statistics()
    assert seen == sorted(set(seen))
    assert statistics.received == 500 == statistics.delivered + statistics.replaced + statistics.after_close
    assert statistics.delivered == len(seen)


@pytest.mark.parametrize("max_age", [0.0, -1.0, float("nan"), float("inf")])
def test_a_freshness_gate_that_is_not_a_positive_time_is_refused(max_age: float):
    with pytest.raises(ConfigError, match="max_age: expected a positive number of seconds, found"):
        Mailbox(max_age=max_age)


# --- with missing cameras -------------------------------------------------------------------------------------------


def cycles(cameras: Iterable[str], first: int, count: int) -> list[Arrival]:
    """One image of each camera per period, 2 ms apart."""
    return [
        (camera, (10 + first + cycle) * PERIOD + PANDASET.index(camera) * 2 * MS)
        for cycle in range(count)
        for camera in cameras
    ]


def without(*dead: str) -> list[str]:
    return [camera for camera in PANDASET if camera not in dead]


def partial_synchronizer(min_cameras: int) -> SurroundSynchronizer[Arrival]:
    return SurroundSynchronizer(PANDASET, "front", 0.05, min_cameras=min_cameras)


def test_a_camera_that_dies_is_awaited_for_three_periods_then_no_more_and_returns_with_its_next_image():
    synchronizer = partial_synchronizer(4)
    assert len(feed(synchronizer, cycles(PANDASET, 0, 5), flush=False)) == 5
    dead = cycles(without("left"), 5, 8)
    sets = [synchronizer.add(camera, stamp, (camera, stamp)) for camera, stamp in dead]
    waiting = next(i for i, leaving in enumerate(sets) if leaving)
    assert dead[waiting][1] - dead[0][1] < 3.2 * PERIOD
    assert [s.stamp_ns // PERIOD - 10 for leaving in sets for s in leaving] == list(range(5, 13))
    assert all(list(s.images) == without("left") for leaving in sets for s in leaving)
    # From then on nobody waits: each set leaves with its own last image.
    assert [i % 5 for i, leaving in enumerate(sets) if leaving][1:] == [4] * (8 - waiting // 5)
    back = feed(synchronizer, cycles(PANDASET, 13, 3), flush=False)
    assert [len(s.images) for s in back][-2:] == [6, 6]
    assert synchronizer.statistics().cameras["left"].missed in (8, 9)


def test_another_camera_stands_in_for_the_anchor_until_it_returns():
    synchronizer = partial_synchronizer(4)
    alive = feed(synchronizer, cycles(PANDASET, 0, 5), flush=False)
    headless = feed(synchronizer, cycles(without("front"), 5, 8), flush=False)
    back = feed(synchronizer, cycles(PANDASET, 13, 5))
    assert {s.anchor for s in alive} == {"front"}
    assert {s.anchor for s in headless} == {"front_left"}
    assert all(s.stamp_ns == s.stamps_ns["front_left"] and "front" not in s.images for s in headless)
    assert (len(headless), len(back)) in ((7, 6), (8, 5))
    assert [(s.anchor, len(s.images)) for s in back][-4:] == [("front", 6)] * 4
    stamps = [s.stamp_ns for s in alive + headless + back]
    assert stamps == sorted(set(stamps))


@pytest.mark.parametrize("min_cameras", [1, 4, 5])
@pytest.mark.parametrize("camera", ["front", "back"])
@pytest.mark.parametrize("ahead", [15 * PERIOD, 36_000 * PERIOD])
@pytest.mark.parametrize("healthy", [0, 5])
def test_a_camera_whose_clock_is_ahead_costs_its_own_images_only_even_when_it_is_the_anchor(
    min_cameras: int, camera: str, ahead: int, healthy: int
):
    synchronizer = partial_synchronizer(min_cameras)
    feed(synchronizer, cycles(PANDASET, 0, healthy), flush=False)
    wrong = [(name, stamp + ahead * (name == camera)) for name, stamp in cycles(PANDASET, healthy, 20)]
    sets = [s for s in feed(synchronizer, wrong, flush=False) if len(s.images) == 5]
    assert len(sets) >= 14
    assert all(list(s.images) == without(camera) and s.anchor == without(camera)[0] for s in sets)
    mended = feed(synchronizer, cycles(PANDASET, healthy + 20, 10))
    assert [(s.anchor, len(s.images)) for s in mended][-5:] == [("front", 6)] * 5


@pytest.mark.parametrize("min_cameras", [2, 3])
def test_an_anchor_whose_clock_is_ahead_costs_nothing_more_where_other_cameras_are_dead(min_cameras: int):
    synchronizer = partial_synchronizer(min_cameras)
    alive = without("left", "right")
    wrong = [(name, stamp + 36_000 * PERIOD * (name == "front")) for name, stamp in cycles(alive, 0, 20)]
    sets = feed(synchronizer, wrong, flush=False)
    assert [list(s.images) for s in sets[-10:]] == [["front_left", "back", "front_right"]] * 10


def test_cameras_whose_stamps_stand_still_do_not_depose_the_others():
    synchronizer = partial_synchronizer(2)
    feed(synchronizer, cycles(PANDASET, 0, 5), flush=False)
    moving = ("front", "front_left")
    standing = [
        (n, stamp if n in moving else (14 * PERIOD + PANDASET.index(n))) for n, stamp in cycles(PANDASET, 5, 20)
    ]
    sets = feed(synchronizer, standing, flush=False)
    assert [list(s.images) for s in sets[-10:]] == [list(moving)] * 10


def test_too_few_cameras_give_no_set():
    synchronizer = partial_synchronizer(4)
    assert feed(synchronizer, cycles(without("left", "back", "right"), 0, 10)) == []


def test_without_min_cameras_a_dead_camera_holds_every_set_back():
    synchronizer = partial_synchronizer(0)
    assert feed(synchronizer, cycles(without("left"), 0, 10)) == []


def test_an_image_too_far_from_the_others_stays_behind_alone():
    synchronizer = partial_synchronizer(5)
    late = [
        (c, stamp - 30 * MS if c == "left" else stamp + 25 * MS * (c == "back")) for c, stamp in cycles(PANDASET, 0, 5)
    ]
    sets = feed(synchronizer, sorted(late, key=lambda arrival: arrival[1]))
    assert len(sets) == 5
    assert all(s.spread_ns <= 50 * MS and "front" in s.images and len(s.images) == 5 for s in sets)


@given(st.integers(1, 6), st.lists(st.tuples(st.sampled_from(PANDASET), st.integers(0, 30)), max_size=4), st.data())
@settings(max_examples=60, deadline=None)
def test_whatever_dies_and_returns_every_set_is_large_and_close_enough(min_cameras, deaths, data):
    gone = {
        (camera, cycle) for camera, start in deaths for cycle in range(start, start + data.draw(st.integers(1, 20)))
    }
    arrivals = [(c, stamp) for c, stamp in cycles(PANDASET, 0, 40) if (c, stamp // PERIOD - 10) not in gone]
    synchronizer = partial_synchronizer(min_cameras)
    sets = feed(synchronizer, arrivals)
    assert all(len(s.images) >= min_cameras and s.spread_ns <= 50 * MS for s in sets)
    assert all(s.stamp_ns == s.stamps_ns[s.anchor] for s in sets)
    stamps = [s.stamp_ns for s in sets]
    assert stamps == sorted(set(stamps))
    used = [image for s in sets for image in s.images.values()]
    assert len(used) == len(set(used))
    for statistics in synchronizer.statistics().cameras.values():
        assert statistics.received == statistics.matched + statistics.queued + sum(statistics.dropped.values())
    possible = sum(sum((c, n) not in gone for c in PANDASET) >= min_cameras for n in range(40))
    assert len(sets) >= possible - 4 * len(deaths)


@pytest.mark.parametrize("min_cameras", [-1, 7, True, 2.0])
def test_an_impossible_min_cameras_is_refused(min_cameras: Any):
    with pytest.raises(ConfigError, match="min_cameras: expected a whole number from 0 to 6"):
        SurroundSynchronizer(PANDASET, "front", 0.05, min_cameras=min_cameras)
