# SPDX-License-Identifier: Apache-2.0
"""The processor that is running: which instructions it has."""

from functools import lru_cache
from pathlib import Path

BFLOAT16 = ("avx512_bf16", "amx_bf16")
"""Instructions that multiply bfloat16, as Linux names them: twice as quick as float32 and more."""

_CPU_INFO = Path("/proc/cpuinfo")


def multiplies_bfloat16() -> bool:
    """Tell whether the processor multiplies bfloat16 itself; where Linux does not tell, it does not."""
    return not instructions().isdisjoint(BFLOAT16)


@lru_cache(maxsize=1)
def instructions() -> frozenset[str]:
    """Return the extensions that Linux lists for the first processor; none on other systems."""
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.split(":", 1)[1].split() for line in lines if line.startswith("flags")), ()))
