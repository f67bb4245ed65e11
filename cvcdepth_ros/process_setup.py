# SPDX-License-Identifier: Apache-2.0
"""What a process that moves large images over DDS must set up before anything else. Call it first in `main`."""

import ctypes
import os

from cvcdepth_ros.share import share_directory

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc, malloc.h
_PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


def prepare_process() -> None:
    """Keep freed image buffers in the process, and give FastDDS shared memory that holds a whole surround set.

    The user's own settings have precedence: the environment variables are only set where they are not.
    """
    _keep_large_buffers()
    profile = str(share_directory() / "config" / "fastdds_large_shm.xml")
    if not any(variable in os.environ for variable in _PROFILE_VARIABLES):
        os.environ.update(dict.fromkeys(_PROFILE_VARIABLES, profile))


def _keep_large_buffers() -> None:
    """Stop glibc from returning every freed message to the kernel and faulting its pages in again for the next.

    Measured: 700 000 page faults in 4 s and dropped images without it. Other C libraries have no mallopt.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, 64 << 20)
        mallopt(_M_TRIM_THRESHOLD, 512 << 20)
