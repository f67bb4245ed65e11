# SPDX-License-Identifier: Apache-2.0
"""Arrays that published programs computed: read, compared, and none of them forgotten."""

import zlib
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

FLOAT64 = 1e-9


class GoldenArrays:
    """One file of arrays; a family's files remember together which outputs no test has looked at yet.

    Each family derives a class of its own, with an `unseen` of its own.
    """

    unseen: ClassVar[dict[str, set[str]]]

    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=False) as file:
            self._arrays = {name: file[name] for name in file.files}
        outputs = {name for name in self._arrays if name.startswith("out_")}
        self._unseen = self.unseen.setdefault(path.name, outputs)

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def __getitem__(self, name: str) -> NDArray[np.generic]:
        self._unseen.discard(name)
        return self._arrays[name]

    def names(self, prefix: str) -> list[str]:
        """Names of the arrays that begin so."""
        return [name for name in self._arrays if name.startswith(prefix)]

    def tensor(self, name: str, dtype: torch.dtype = torch.float64) -> Tensor:
        return torch.tensor(self[name]).to(dtype)


def assert_equal(ours: Tensor, golden: NDArray[np.generic], tolerance: float = FLOAT64) -> None:
    ours = ours.detach().double().reshape(golden.shape)
    expected = torch.tensor(golden).double()
    worst = float((ours - expected).abs().max())
    assert worst <= tolerance * float(expected.abs().max()), f"off by {worst}"


def assert_equal_each(ours: Tensor, golden: NDArray[np.generic], tolerance: float = FLOAT64) -> None:
    """Compare relative to each element, for arrays whose elements are of different kinds or sizes."""
    torch.testing.assert_close(
        ours.detach().double().reshape(golden.shape), torch.tensor(golden).double(), rtol=tolerance, atol=tolerance
    )


def assert_masks_equal(ours: Tensor, golden: NDArray[np.generic]) -> None:
    different = int((ours.detach().double().reshape(golden.shape) != torch.tensor(golden)).sum())
    assert different <= 2, f"{different} pixels of the mask differ"


def weight(key: str, like: Tensor, seed: int = 0, gain: float = 1.0) -> Tensor:
    """The weights that the golden pages define by a network's key; `gain` is that of kernels."""
    z = np.random.RandomState((zlib.crc32(key.encode()) + seed) & 0x7FFFFFFF).standard_normal(tuple(like.shape))
    if key.endswith("num_batches_tracked"):
        z = np.zeros(())
    elif key.endswith("running_var"):
        z = 1 + 0.25 * np.abs(z)
    elif like.ndim >= 2:
        z = z * np.sqrt(gain / np.prod(like.shape[1:]))
    else:
        z = 1 + 0.1 * z if key.endswith("weight") else 0.1 * z
    return torch.tensor(z).to(like.dtype)
