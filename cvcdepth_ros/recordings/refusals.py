# SPDX-License-Identifier: Apache-2.0
"""Counts and reasons of the messages and sets that cannot be used."""

from collections.abc import Iterator
from contextlib import contextmanager

from cvcdepth_core.errors import CvcDepthError

_KEPT_REASONS = 100


class Refusals:
    """Messages and sets that could not be used: how many, and the first hundred reasons."""

    def __init__(self) -> None:
        self.count = 0
        self.reasons: list[str] = []

    def add(self, reason: str) -> None:
        """Count one more."""
        self.count += 1
        if len(self.reasons) < _KEPT_REASONS:
            self.reasons.append(reason)

    @contextmanager
    def instead_of_errors(self) -> Iterator[None]:
        """Count an error of the family that the block raises, in place of raising it."""
        try:
            yield
        except CvcDepthError as error:
            self.add(str(error))

    def __str__(self) -> str:
        return f"{self.count} refused, the first: {self.reasons[0]}" if self.count else "none refused"
