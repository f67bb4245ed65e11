# SPDX-License-Identifier: Apache-2.0
"""The look that all pages and diagrams share: the contact sheets' dark colours, figures, pictures in a page."""

from __future__ import annotations

import base64
import colorsys
import io
import math
from collections.abc import Mapping
from itertools import count, islice
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.visualization import BACKGROUND, GRID, QUIET_TEXT, WARNING
from cvcdepth_core.visualization import PANEL as _PANEL
from cvcdepth_core.visualization import TEXT as _TEXT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def _css(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


GROUND, PANEL, TEXT, LINES, YELLOW = map(_css, (BACKGROUND, _PANEL, _TEXT, GRID, WARNING))
BLUE, RED, GREEN = "#4fb3ff", "#ff7a8a", "#79e08f"
COLOURS: Mapping[str, str] = {
    "ground": GROUND,
    "panel": PANEL,
    "text": TEXT,
    "quiet": _css(QUIET_TEXT),
    "lines": LINES,
    "faint-lines": "#2b3038",
    "warning": YELLOW,
    "good": GREEN,
    "link": BLUE,
}
"""The pages' colours by what they are for."""

_SERIES = (YELLOW, RED, GREEN, "#c792ea", "#f78c6c", "#89ddff", "#b0bec5")
_GOLDEN_RATIO = 0.618034  # of the circle of hues: each step falls into the widest gap
_DPI = 130
_JPEG_QUALITY = 85


def css_colours() -> str:
    """Return `COLOURS` as CSS variables: `var(--ground)` and so on."""
    return f":root {{ {' '.join(f'--{name}: {colour};' for name, colour in COLOURS.items())} }}"


def series_colours(number: int) -> list[str]:
    """Return as many colours as there are series in a diagram, no two the same: a few chosen ones, then hues."""
    hues = (colorsys.hsv_to_rgb(step * _GOLDEN_RATIO % 1, 0.45, 0.95) for step in count(1))
    generated = [_css((round(255 * r), round(255 * g), round(255 * b))) for r, g, b in islice(hues, number)]
    return [*_SERIES, *generated][:number]


def dark_figure(width: float, height: float, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of `width` x `height` inches in the pages' colours, with axes one below the other.

    Nothing here touches matplotlib's global state.
    """
    from matplotlib.figure import Figure  # here, for the demo's page has the same colours and needs no matplotlib

    figure = Figure((width, height), dpi=_DPI, facecolor=GROUND, layout="constrained")
    all_axes = [figure.add_subplot(rows, 1, row + 1, facecolor=PANEL) for row in range(rows)]
    for axes in all_axes:
        axes.tick_params(colors=TEXT, labelsize=8)
        axes.grid(axis="y", color=LINES, linewidth=0.6)
        axes.set_axisbelow(True)
        for spine in axes.spines.values():
            spine.set_color(LINES)
    return figure, all_axes


def add_title(axes: Axes, text: str) -> None:
    """Write what the axes show above them."""
    axes.set_title(text, loc="left", color=TEXT, fontsize=11)


def add_legend(axes: Axes) -> None:
    """Name what is drawn, where it has names."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, facecolor=PANEL, edgecolor=LINES, labelcolor=TEXT)


def to_png(figure: Figure) -> bytes:
    """Return the figure as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def to_jpeg(picture: Picture) -> bytes:
    """Return the picture as a JPEG file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    return bytes(encoded)


def to_number(value: float | None, digits: int = 3) -> str:
    """Return a number as pages show it; a dash for NaN and None."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def to_data_url(content: bytes, kind: str) -> str:
    """Return an address that holds a picture file of this kind (png, jpeg)."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def render_page(template: str, content: Mapping[str, Any]) -> str:
    """Return the page that the template in `templates/` makes of `content`; whatever comes from files is escaped."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(__package__), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters |= {"number": to_number, "data_url": to_data_url}
    return environment.get_template(template).render(content, css_colours=css_colours())
