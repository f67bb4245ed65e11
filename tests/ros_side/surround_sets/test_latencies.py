# SPDX-License-Identifier: Apache-2.0
import json
import threading
from pathlib import Path

import pytest

from cvcdepth_core.errors import OutputError
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.trace_file import TraceFile


def test_percentiles_are_of_the_last_thousand_and_the_total_is_of_all():
    latencies = StageLatencies()
    for milliseconds in range(2000):
        latencies.record("decode", milliseconds / 1e3)
    summary = latencies.summaries()["decode"]
    assert (summary.count, summary.max_ms) == (1000, 1999)
    assert summary.p50_ms == pytest.approx(1499.5)
    assert summary.total_s == pytest.approx(1999.0)


def test_the_trace_has_every_measured_stage_on_its_threads_track(tmp_path):
    trace = TraceFile(tmp_path / "trace.json")
    latencies = StageLatencies(trace)

    def work() -> None:
        with latencies.measure("decode"), latencies.measure("inner"):
            pass

    threads = [threading.Thread(target=work, name=f"worker {i}") for i in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    trace.close()
    events = json.loads((tmp_path / "trace.json").read_text())
    spans = [event for event in events if event["ph"] == "X"]
    assert sorted(event["name"] for event in spans) == ["decode"] * 3 + ["inner"] * 3
    names = {event["tid"]: event["args"]["name"] for event in events if event["name"] == "thread_name"}
    assert sorted(names.values()) == ["worker 0", "worker 1", "worker 2"]
    for tid in names:
        inner, outer = (event for event in spans if event["tid"] == tid)
        assert outer["ts"] <= inner["ts"]
        assert inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"] + 1


def test_a_trace_stops_at_its_limit_and_can_still_be_read(tmp_path):
    trace = TraceFile(tmp_path / "trace.json", limit_bytes=5000)
    for number in range(1000):
        trace.span("decode", number, number + 0.5, camera="front")
    trace.close()
    trace.span("late", 0, 1)
    content = (tmp_path / "trace.json").read_text()
    assert len(content) < 5200
    assert 20 < len(json.loads(content)) < 100


def test_a_trace_that_was_never_closed_lacks_only_its_end(tmp_path):
    trace = TraceFile(tmp_path / "trace.json")
    trace.span("decode", 1.0, 2.5)
    trace.flush()
    events = json.loads((tmp_path / "trace.json").read_text().rstrip(",\n") + "]")
    assert (events[-1]["ts"], events[-1]["dur"]) == (1_000_000, 1_500_000)


def test_a_trace_that_cannot_be_written_is_refused_by_name(tmp_path):
    with pytest.raises(OutputError, match=r"trace .*no/trace\.json: cannot be written"):
        TraceFile(tmp_path / "no" / "trace.json")


def test_a_full_disk_ends_the_trace_and_nothing_else():
    trace = TraceFile(Path("/dev/full"))
    for number in range(5000):
        trace.span("decode", number, number + 1)
    trace.close()
