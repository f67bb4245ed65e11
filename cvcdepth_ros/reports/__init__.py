# SPDX-License-Identifier: Apache-2.0
"""HTML pages and figures."""

from importlib.util import find_spec

from cvcdepth_ros.console import warn

REPORT_FILE = "report.html"
"""The page beside the results of `evaluate` and `finetune`."""


def can_draw_report() -> bool:
    """Return whether the page can be made, with a warning where it cannot; to be asked before the work begins."""
    missing = [name for name in ("jinja2", "matplotlib") if find_spec(name) is None]
    if missing:
        warn(f"no {REPORT_FILE}: {' and '.join(missing)} not installed; pip install 'cvcdepth_ros[report]' brings it")
    return not missing
