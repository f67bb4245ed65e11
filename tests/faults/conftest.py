# SPDX-License-Identifier: Apache-2.0
"""`pytest tests/faults --fault-table FILE` appends the table of what was measured to FILE."""

from collections.abc import Iterator

import pytest

from faults.table import FaultTable


@pytest.fixture(scope="module")
def fault_table(request: pytest.FixtureRequest) -> Iterator[FaultTable]:
    table = FaultTable()
    yield table
    path = request.config.getoption("--fault-table")
    if path is not None:
        table.write(path)
