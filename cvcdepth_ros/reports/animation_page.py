# SPDX-License-Identifier: Apache-2.0
"""One HTML page that needs nothing beside it: the sets as an animation, and the tables."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from string import Template

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>$title</title>
<style>
  body { margin: 0 auto; max-width: 1920px; padding: 16px; background: #121418; color: #ebeef2;
         font: 16px/1.5 system-ui, sans-serif; }
  h1 { font-size: 1.4em; margin: 0 0 8px; }
  .warning { color: #ffc440; font-weight: bold; }
  .sets img { width: 100%; display: block; }
  .sets img[hidden] { display: none; }
  .controls { display: flex; gap: 16px; align-items: center; padding: 12px 0; }
  .controls input { flex: 1; }
  button { font: inherit; min-width: 6em; padding: 4px 12px; }
  .tables { display: flex; flex-wrap: wrap; gap: 16px 64px; }
  table { border-collapse: collapse; }
  caption { text-align: left; font-weight: bold; padding: 8px 0; }
  th, td { text-align: left; padding: 3px 24px 3px 0; border-bottom: 1px solid #3e444e; font-weight: normal; }
  td { font-variant-numeric: tabular-nums; }
  footer { color: #969eaa; padding-top: 16px; }
</style>
</head>
<body>
<h1>$title</h1>
$warning
<div class="sets">
$images
</div>
<div class="controls">
  <button type="button" id="play">Play</button>
  <input type="range" id="slider" aria-label="set" min="1" max="$count" value="1">
  <output id="number" for="slider">1 of $count</output>
</div>
<div class="tables">
$tables
</div>
<footer>$notes</footer>
<script>
  const images = document.querySelectorAll(".sets img");
  const play = document.getElementById("play");
  const slider = document.getElementById("slider");
  const number = document.getElementById("number");
  let timer = null;
  function show() {
    images.forEach((image, index) => { image.hidden = index !== slider.value - 1; });
    number.value = slider.value + " of " + images.length;
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  }
  function step() {
    slider.value = slider.value % images.length + 1;
    show();
  }
  play.addEventListener("click", () => {
    if (timer) { stop(); return; }
    timer = setInterval(step, $interval);
    play.textContent = "Pause";
  });
  slider.addEventListener("input", () => { stop(); show(); });
  show();
</script>
</body>
</html>
""")

_FRAME_MILLISECONDS = 400

Table = tuple[str, Sequence[Sequence[str]]]
"""A caption and the rows; the first cell of a row is its heading."""


def animation_page(
    title: str, warning: str, jpegs: Sequence[bytes], tables: Iterable[Table], notes: Iterable[str]
) -> str:
    """Return the page; all text is escaped."""
    return _PAGE.substitute(
        title=escape(title),
        warning=f'<p class="warning">{escape(warning)}</p>' if warning else "",
        images="\n".join(_image(index, jpeg) for index, jpeg in enumerate(jpegs)),
        count=len(jpegs),
        tables="\n".join(_table(caption, rows) for caption, rows in tables),
        notes="<br>".join(map(escape, notes)),
        interval=_FRAME_MILLISECONDS,
    )


def _image(index: int, jpeg: bytes) -> str:
    content = base64.b64encode(jpeg).decode("ascii")
    hidden = " hidden" if index else ""
    return f'<img alt="set {index + 1}"{hidden} src="data:image/jpeg;base64,{content}">'


def _table(caption: str, rows: Sequence[Sequence[str]]) -> str:
    lines = "\n".join(
        f"<tr><th>{escape(heading)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
        for heading, *cells in rows
    )
    return f"<table><caption>{escape(caption)}</caption>\n{lines}\n</table>"
