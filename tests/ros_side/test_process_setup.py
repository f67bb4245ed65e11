# SPDX-License-Identifier: Apache-2.0
"""What programs do to their process before they begin."""

import platform
import re

import pytest
from program_setup import WATCH_TORCH, output_of

from cvcdepth_ros.process_setup import openmp_environment

needs_glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has arenas and mallopt")

PROGRAM = """
from cvcdepth_ros.bag_replay import main
main(["export", "no_such_file.safetensors"])
"""

ARENAS = """
import ctypes, threading
from cvcdepth_ros.process_setup import prepare_long_work, prepare_process

libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes = [ctypes.c_size_t]
{setup}()
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

FAULTS = """
import resource
import numpy as np
from cvcdepth_ros.process_setup import prepare_long_work, prepare_process

{setup}()
np.ones(200 << 17)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
np.ones(200 << 17)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@needs_glibc
@pytest.mark.parametrize("setup", ["prepare_process", "prepare_long_work"])
def test_the_threads_of_a_prepared_process_share_one_malloc_arena(setup: str) -> None:
    script = ARENAS.format(setup=setup)
    assert len(re.findall("<heap nr", output_of(script))) == 1
    assert len(re.findall("<heap nr", output_of(script, MALLOC_ARENA_MAX="3"))) == 3  # a setting of the user's


@needs_glibc
def test_long_work_keeps_the_feature_maps_that_it_has_freed() -> None:
    """200 MB are 51 200 pages of 4 KiB, or as few as 100 of 2 MiB where the kernel gives such."""
    script = FAULTS.format(setup="prepare_long_work")
    assert int(output_of(script)) < 20
    assert int(output_of(script, MALLOC_MMAP_THRESHOLD_="1000000")) >= 100


def test_openmps_threads_soon_sleep_unless_the_user_says_how_they_wait() -> None:
    assert openmp_environment({}) == {"GOMP_SPINCOUNT": "3000"}
    assert openmp_environment({"GOMP_SPINCOUNT": "10"}) == {}
    assert openmp_environment({"OMP_WAIT_POLICY": "active"}) == {}


@pytest.mark.parametrize(("environment", "found"), [({}, "3000"), ({"GOMP_SPINCOUNT": "7"}, "7")])
def test_the_tool_says_how_threads_wait_before_it_loads_torch(environment: dict[str, str], found: str) -> None:
    assert f"torch: {found}\n" in output_of(WATCH_TORCH + PROGRAM, **environment)
