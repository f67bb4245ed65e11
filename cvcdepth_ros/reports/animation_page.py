# SPDX-License-Identifier: Apache-2.0
"""One HTML page that needs nothing beside it: the sets as an animation, and the tables."""

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from string import Template

from cvcdepth_ros.reports.style import css_colours, to_data_url

_FRAME_MILLISECONDS = 400

Table = tuple[str, Sequence[Sequence[str]]]
"""A caption and the rows; the first cell of a row is its heading."""


def animation_page(
    title: str, warning: str, jpegs: Sequence[bytes], tables: Iterable[Table], notes: Iterable[str]
) -> str:
    """Return the page; all text is escaped."""
    template = Template((resources.files(__package__) / "templates" / "animation.html").read_text(encoding="utf-8"))
    return template.substitute(
        colours=css_colours(),
        title=escape(title),
        warning=f'<p class="warning">{escape(warning)}</p>' if warning else "",
        images="\n".join(_image(index, jpeg) for index, jpeg in enumerate(jpegs)),
        count=len(jpegs),
        tables="\n".join(_table(caption, rows) for caption, rows in tables),
        notes="<br>".join(map(escape, notes)),
        interval=_FRAME_MILLISECONDS,
    )


def _image(index: int, jpeg: bytes) -> str:
    hidden = " hidden" if index else ""
    return f'<img alt="set {index + 1}"{hidden} src="{to_data_url(jpeg, "jpeg")}">'


def _table(caption: str, rows: Sequence[Sequence[str]]) -> str:
    lines = "\n".join(
        f"<tr><th>{escape(heading)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
        for heading, *cells in rows
    )
    return f"<table><caption>{escape(caption)}</caption>\n{lines}\n</table>"
