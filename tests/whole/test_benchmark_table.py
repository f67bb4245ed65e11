# SPDX-License-Identifier: Apache-2.0
"""The page of all benchmarks: made of their JSON lines, each in its place."""

import json
import re
import sys
from pathlib import Path

import pytest
from repository import ROOT

PAGE = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
SCRIPTS = [
    path
    for path in sorted((ROOT / "benchmarks").glob("*.py"))
    if path.stem not in ("measuring", "table", "camera_loop")
]


@pytest.fixture
def benchmarks(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import measuring
    import table

    yield measuring, table
    for name in ("measuring", "table", "node"):
        sys.modules.pop(name, None)


def test_every_benchmark_has_its_place_on_the_page():
    named = [re.findall(r"""json_lines\(\s*"(\w+)"|"benchmark": "(\w+)\"""", path.read_text()) for path in SCRIPTS]
    assert all(named)
    assert {"".join(name) for names in named for name in names} == set(re.findall(r"<!-- bench: (\w+) -->", PAGE))


def test_lines_become_a_table_that_replaces_the_former_one(benchmarks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    measuring, table = benchmarks
    timings = {"slow": measuring.Timings([0.4, 0.2, 0.3], [0.3] * 3), "ours": measuring.Timings([0.1] * 3, [0.1] * 3)}
    lines = list(measuring.json_lines("cloud", timings, "slow", {"cameras": 6}))
    assert [line["times_baseline"] for line in lines] == [1.0, 3.0]
    results, page = tmp_path / "cloud.jsonl", tmp_path / "page.md"
    results.write_text("".join(json.dumps(line) + "\n" for line in lines))
    page.write_text("before\n<!-- bench: cloud -->\nformer\n<!-- end -->\nafter\n")
    monkeypatch.setattr(sys, "argv", ["table.py", str(results), "--page", str(page)])
    for _ in range(2):
        table.main()
    text = page.read_text()
    assert "former" not in text
    assert text.startswith("before\n<!-- bench: cloud -->\n|  | median ms | p95 ms |")
    assert "| slow | 300 | 400 | 3.33 |" in text
    assert "medians of 3 rounds, baseline: slow; cameras 6; Python" in text
    assert text.endswith("<!-- end -->\nafter\n")


def test_a_benchmark_without_a_place_is_an_error(benchmarks):
    with pytest.raises(ValueError, match="benchmark 'cloud' has 0 places"):
        benchmarks[1].with_table("a page", "cloud", "")


def test_cases_take_turns_and_the_first_round_is_not_counted(benchmarks):
    order = []
    timings = benchmarks[0].measure_in_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert "".join(order) == "ababab"
    assert {name: (len(found.wall), len(found.cpu)) for name, found in timings.items()} == {"a": (2, 2), "b": (2, 2)}


def test_the_lines_of_the_nodes_benchmark_have_all_that_the_table_needs(
    benchmarks, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    import node

    found = dict.fromkeys(("median_ms", "p95_ms", "per_second", "outside_inference", "peak_memory_mb"), 2.0)
    found |= {"sets_received": 7, "age_ms": {"p50": 1.0, "p95": 2.0}, "stages_ms": {"inference": {"p50_ms": 1.5}}}
    monkeypatch.setattr(node, "measured", lambda *_: found | {"baseline": found | {"median_ms": 8.0}})
    monkeypatch.setattr(sys, "argv", ["node.py", "--against", "yesterday", "--rounds", "2"])
    node.main()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    times = [(line["case"], line["times_baseline"]) for line in lines]
    assert times == [("straightforward", 1.0), ("node", 4.0), ("node of yesterday", 4.0)]
    assert "medians of 7 rounds" in benchmarks[1].markdown(lines)
