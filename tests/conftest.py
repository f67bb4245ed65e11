# SPDX-License-Identifier: Apache-2.0
"""Options and fixtures shared by the tests."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults.table import FaultTable
from s3_server import LocalS3, local_s3

# A shell that runs the tests in the background has them ignore SIGINT, and the programs they start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Read by torch and OpenCV when they are loaded, here and in the programs that tests start. Tests run beside each other,
# and threads that share a processor wait for each other most of the time.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENCV_FOR_THREADS_NUM"] = "1"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--golden-dir",
        type=Path,
        default=Path(__file__).parent / "whole" / "golden",
        help="where test_golden.py finds the published program's arrays",
    )
    parser.addoption(
        "--golden-vfdepth-dir",
        type=Path,
        default=Path(__file__).parent / "whole" / "golden_vfdepth",
        help="the same for test_golden_vfdepth.py",
    )
    parser.addoption(
        "--golden-surrounddepth-dir",
        type=Path,
        default=Path(__file__).parent / "whole" / "golden_surrounddepth",
        help="the same for test_golden_surrounddepth.py",
    )
    parser.addoption("--all-faults", action="store_true", help="inject all faults into the node, not only every fifth")
    parser.addoption("--fault-table", type=Path, help="where the tests of faults write what they measured")


@pytest.fixture(scope="module")
def fault_table(request: pytest.FixtureRequest) -> Iterator[FaultTable]:
    """Collects the reactions to faults; with --fault-table FILE they are appended to it."""
    table = FaultTable()
    yield table
    path = request.config.getoption("--fault-table")
    if path is not None:
        table.write(path)


@pytest.fixture(scope="module")
def s3() -> Iterator[LocalS3]:
    """A local S3 server with an empty bucket; s3:// URLs lead to it."""
    pytest.importorskip("moto", reason="no S3 server in this environment")
    with local_s3() as server:
        yield server
