# SPDX-License-Identifier: Apache-2.0
"""Setup of a program's process: how it keeps memory, how its threads wait, and how DDS carries large images.

The user's own settings have precedence: nothing is set whose environment variable is. Nothing here loads torch.
"""

import ctypes
import gc
import os
from collections.abc import Mapping
from typing import NamedTuple

from cvcdepth_ros.installation import share_directory

_MALLOC_OPTIONS = {"MALLOC_MMAP_THRESHOLD_": -3, "MALLOC_TRIM_THRESHOLD_": -1, "MALLOC_ARENA_MAX": -8}
"""Of glibc: environment variable (mallopt(3)) and its number in malloc.h."""
_WAITING_VARIABLES = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
_SPINS = "3000"
"""Checks of a thread that waits, a few microseconds each at most, before it sleeps."""
_PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


class _Kept(NamedTuple):
    """Bytes of freed memory that glibc does not return."""

    of_block: int
    in_all: int


_OF_MESSAGES = _Kept(64 << 20, 512 << 20)
_OF_FEATURE_MAPS = _Kept(1 << 30, (2 << 30) - 1)  # 2 GiB would not fit mallopt's int


def openmp_environment(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return what to add to `environment`, before torch is loaded, so that idle threads soon sleep.

    GNU's OpenMP, which torch brings, has them spin for long. Where something else uses the processors, the thread that
    all wait for then waits itself for those that spin: a training step of 1.5 s took 31 s on two threads beside other
    work. Not to spin at all costs a quarter of a step on a quiet machine.
    """
    return {} if any(name in environment for name in _WAITING_VARIABLES) else {"GOMP_SPINCOUNT": _SPINS}


def prepare_process() -> None:
    """Keep freed image buffers in the process, and give FastDDS shared memory that holds a whole surround set."""
    _keep_large_buffers(_OF_MESSAGES)
    profile = str(share_directory() / "config" / "fastdds_large_shm.xml")
    if not any(variable in os.environ for variable in _PROFILE_VARIABLES):
        os.environ.update(dict.fromkeys(_PROFILE_VARIABLES, profile))


def prepare_long_work() -> None:
    """Keep the freed feature maps of training and of work through recordings, which the next step needs again."""
    _keep_large_buffers(_OF_FEATURE_MAPS)


def return_memory() -> None:
    """Return unused memory to the system, after something large was dropped.

    Python delays it, for it does not know how much memory a network has outside of it; and glibc was set up to keep
    it (`prepare_process`).
    """
    gc.collect()
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim is not None:
        malloc_trim(0)


def _keep_large_buffers(kept: _Kept) -> None:
    """Stop glibc from returning freed memory to the kernel and faulting its pages in again for the next.

    Measured: 700 000 page faults in 4 s and dropped images without it, and a fifth to a third of a training step. What
    is kept is kept once: with an arena for every thread, each keeps its own copy of the largest buffers that it ever
    had. Other C libraries have no mallopt.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    for (variable, option), value in zip(_MALLOC_OPTIONS.items(), (*kept, 1), strict=True):
        if mallopt is not None and variable not in os.environ:
            mallopt(option, value)
