# SPDX-License-Identifier: Apache-2.0
"""The learning curves of a run, from its log."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cvcdepth_ros.reports.style import (
    BLUE,
    GREEN,
    RED,
    TEXT,
    YELLOW,
    add_legend,
    add_title,
    dark_figure,
    series_colours,
)

_SMOOTHED_OVER = 50  # parts of the run: a point of the curve is the mean of one


class RunLog(NamedTuple):
    """The entries of a run's log."""

    steps: list[dict[str, Any]]
    validations: list[dict[str, Any]]

    @classmethod
    def read(cls, path: Path) -> RunLog:
        """Read `log.jsonl`; a log without entries where there is no file."""
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        entries = [json.loads(line) for line in lines]
        return cls([e for e in entries if "loss" in e], [e for e in entries if "validation" in e])


def loss_curves(log: RunLog) -> Figure:
    """Draw the loss and each of its unweighted terms over the steps."""
    figure, (loss, terms) = dark_figure(13, 5.2, rows=2)
    _curve(loss, log.steps, lambda entry: float(entry["loss"]), BLUE, "loss")
    names = dict.fromkeys(name for entry in log.steps for name in entry["terms"])
    for name, colour in zip(names, series_colours(len(names)), strict=True):
        _curve(terms, log.steps, _term(name), colour, name)
    terms.set_yscale("log")
    terms.tick_params(which="both", colors=TEXT)
    add_title(loss, "loss")
    add_title(terms, "its terms, without their weights")
    add_legend(terms)
    terms.set_xlabel("step", color=TEXT)
    return figure


def held_out_curves(log: RunLog) -> Figure:
    """Draw the scores of the validations over the steps."""
    figure, (score, others) = dark_figure(13, 5.2, rows=2)
    _points(score, log.validations, "score", BLUE)
    if any("worlds_abs_rel" in entry["validation"] for entry in log.validations):
        _points(score, log.validations, "worlds_abs_rel", GREEN)
        add_legend(score)
    for name, colour in (("spatial_photometric", YELLOW), ("temporal_photometric", GREEN), ("spatial", RED)):
        _points(others, log.validations, name, colour)
    add_title(score, "score that weights are chosen by, on some held-out sets (lower is better)")
    add_title(others, "label-free scores")
    add_legend(others)
    others.set_xlabel("step", color=TEXT)
    return figure


def _term(name: str) -> Callable[[Mapping[str, Any]], float]:
    return lambda entry: float(entry["terms"].get(name, np.nan))


def _curve(
    axes: Axes,
    entries: Sequence[Mapping[str, Any]],
    value: Callable[[Mapping[str, Any]], float],
    colour: str,
    name: str,
) -> None:
    """Draw means over parts of the run, over the single values where these are as many as the eye can tell apart."""
    steps = np.array([entry["step"] for entry in entries], dtype=float)
    values = np.array([value(entry) for entry in entries])
    finite = np.isfinite(values)
    steps, values = steps[finite], values[finite]
    if not len(values):
        return
    parts = min(_SMOOTHED_OVER, len(values))
    means = [part.mean() for part in np.array_split(values, parts)]
    axes.plot(steps, values, color=colour, linewidth=0.5, alpha=0.35)
    axes.plot([part.mean() for part in np.array_split(steps, parts)], means, color=colour, linewidth=1.6, label=name)


def _points(axes: Axes, entries: Sequence[Mapping[str, Any]], name: str, colour: str) -> None:
    known = [(entry["step"], entry["validation"][name]) for entry in entries if name in entry["validation"]]
    if known:
        axes.plot(*zip(*known, strict=True), color=colour, linewidth=1.4, marker="o", markersize=4, label=name)
