# SPDX-License-Identifier: Apache-2.0
"""The look of the pages: one set of colours, which the style sheets and the contact sheets share."""

import re
from importlib import resources

import pytest

from cvcdepth_core import visualization
from cvcdepth_ros import reports
from cvcdepth_ros.reports.animation_page import animation_page
from cvcdepth_ros.reports.style import COLOURS, css_colours, render_page, series_colours, to_number

TEMPLATES = {path.name: path.read_text() for path in (resources.files(reports) / "templates").iterdir()}


def test_style_sheets_name_colours_and_the_names_are_defined():
    """The colour of a shadow apart, which is black."""
    used = {name for text in TEMPLATES.values() for name in re.findall(r"var\(--([\w-]+)\)", text)}
    assert used == COLOURS.keys()
    assert [name for name, text in TEMPLATES.items() if re.search(r"#[0-9a-fA-F]{3,6}\b", text)] == []
    for name, colour in COLOURS.items():
        assert f"--{name}: {colour};" in css_colours()


def test_pages_have_the_background_of_the_contact_sheets():
    assert COLOURS["ground"] == "#{:02x}{:02x}{:02x}".format(*visualization.BACKGROUND)
    assert f"--ground: {COLOURS['ground']};" in animation_page("title", "", [b"jpeg"], [], [])


def test_as_many_colours_as_there_are_series_are_all_different():
    assert [len(set(series_colours(number))) for number in (0, 1, 7, 8, 100)] == [0, 1, 7, 8, 100]


def test_what_is_not_known_is_a_dash():
    assert [to_number(value) for value in (0.12345, float("nan"), None)] == ["0.123", "–", "–"]


def test_a_template_that_misses_something_is_an_error_and_no_gap():
    jinja2 = pytest.importorskip("jinja2", reason="no packages for the page in this environment")
    with pytest.raises(jinja2.UndefinedError):
        render_page("evaluation.html", {})
