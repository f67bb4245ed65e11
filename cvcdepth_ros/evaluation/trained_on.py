# SPDX-License-Identifier: Apache-2.0
"""Which recordings a checkpoint has learned from, and whether it is scored on what it has learned."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks.checkpoint import Checkpoint
from cvcdepth_core.scoring.scores import Measurements

TRAINED_ON = "trained_on"
"""Field of a checkpoint's metadata."""

_MOST_STAMPS = 32


class TrainedPart(NamedTuple):
    """The consecutive sets of one recording that were trained on."""

    recording: str
    """Its name."""
    first_ns: int
    """The anchor image's stamp of the first of them."""
    last_ns: int
    """... and of the last."""
    stamps_ns: tuple[int, ...]
    """Some of the stamps between: a recording is recognised by them, wherever it lies and whatever it is called."""

    @classmethod
    def from_stamps(cls, recording: str, stamps_ns: NDArray[np.int64]) -> TrainedPart:
        """Describe a part by the anchor's stamps [S] of its sets, S > 0."""
        chosen = np.unique(np.linspace(0, len(stamps_ns) - 1, min(_MOST_STAMPS, len(stamps_ns))).round().astype(int))
        first, last = int(stamps_ns.min()), int(stamps_ns.max())
        return cls(recording, first, last, tuple(stamps_ns[chosen].tolist()))

    def sets_among(self, stamps_ns: NDArray[np.int64]) -> int:
        """Return how many of a recording's sets with these stamps [S] belong to the part; 0 for another recording."""
        inside = int(((stamps_ns >= self.first_ns) & (stamps_ns <= self.last_ns)).sum())
        if not inside:
            return 0
        known = [s for s in self.stamps_ns if stamps_ns.min() <= s <= stamps_ns.max()]
        return inside if not known or np.isin(known, stamps_ns).any() else 0


class SeenSets(NamedTuple):
    """Sets of a recording that were scored and had been trained on."""

    recording: str
    """As it is called now."""
    trained_as: str
    """As it was called then."""
    sets: int
    scored: int
    """Sets of the recording that were scored in all."""


# The package's own model was made before checkpoints carried this: sequence 002 of PandaSet, its first 30 sets.
_PANDASET_002 = TrainedPart(
    "pandaset_002",
    1557539958850843904,
    1557539961750027008,
    (
        1557539958850843904,
        1557539959250696960,
        1557539959650564864,
        1557539960050445056,
        1557539960450308096,
        1557539960550249216,
        1557539960650206976,
        1557539960850068992,
        1557539961049966080,
        1557539961249952000,
        1557539961349961984,
        1557539961750027008,
    ),
)
_KNOWN = {"a8cf938731cf097379771f7d7ed22e3384bc012c133c2c02021bb4d690702b2c": (_PANDASET_002,)}
"""Parts by the checkpoint file's SHA-256."""


def trained_parts(checkpoint: Checkpoint | None) -> list[TrainedPart]:
    """Return what a checkpoint was trained on, as far as it says; nothing for random weights (None).

    Raises CheckpointError where it says what cannot be read.
    """
    if checkpoint is None:
        return []
    try:
        told = json.loads(checkpoint.metadata.get(TRAINED_ON, "[]"))
        parts = [TrainedPart(str(name), int(a), int(b), tuple(map(int, stamps))) for name, a, b, stamps in told]
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{checkpoint.path}: metadata '{TRAINED_ON}' is damaged: {error}") from error
    return [*parts, *_KNOWN.get(checkpoint.sha256, ())]


def to_metadata(parts: Iterable[TrainedPart]) -> dict[str, str]:
    """Return the field for a checkpoint's metadata; each part once."""
    return {TRAINED_ON: json.dumps(list(dict.fromkeys(parts)))}


def seen_in_training(parts: Sequence[TrainedPart], scored: Iterable[Measurements]) -> list[SeenSets]:
    """Return which of the scored sets had been trained on, recording by recording."""
    found = []
    for table in scored:
        counts = {part.recording: part.sets_among(table.stamps_ns) for part in parts}
        name = max(counts, key=counts.__getitem__, default="")
        if counts.get(name):
            found.append(SeenSets(table.recording, name, counts[name], len(table)))
    return found
