# SPDX-License-Identifier: Apache-2.0
"""What the node does to its process before it begins."""

import os
import platform
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has arenas")

SCRIPT = """
import ctypes, threading
from cvcdepth_ros.live.process_setup import prepare_process

libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes = [ctypes.c_size_t]
prepare_process()
together = threading.Barrier(4)
def allocate():
    together.wait()
    libc.malloc(100_000)
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""


def arenas(**environment: str) -> int:
    found = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=os.environ | environment, check=True, capture_output=True, text=True
    )
    return len(re.findall("<heap nr", found.stdout))


def test_the_threads_of_a_prepared_process_share_one_malloc_arena() -> None:
    assert arenas() == 1


def test_a_setting_of_the_users_is_left_as_it_is() -> None:
    assert arenas(MALLOC_ARENA_MAX="3") == 3
