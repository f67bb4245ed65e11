# SPDX-License-Identifier: Apache-2.0
"""Options and fixtures shared by the tests."""

from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--golden-dir",
        type=Path,
        default=Path(__file__).parent / "golden",
        help="where test_golden.py finds the published program's arrays",
    )
