# SPDX-License-Identifier: Apache-2.0
"""Fuzz one target, guided by the coverage of all Python code that reads foreign bytes, ours and the libraries'.

    python fuzz/run.py recordings --seconds 3600

An input that raises, crashes, takes more than a second of CPU time or more than 1 GiB is left in `fuzz/findings`, and
the run ends there. What reaches new code is kept in `--corpus` (not in the repository's, whose inputs are only read).
"""

import argparse
import mmap
import resource
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import atheris

HERE = Path(__file__).parent
_CPU_SECONDS = 1.0
_MEBIBYTES = 1024

with atheris.instrument_imports(include=["cvcdepth_core", "cvcdepth_ros", "mcap", "rosbags", "yaml"]):
    sys.path.insert(0, str(HERE))
    import targets


def main() -> None:
    """Run until the time is over or something is found."""
    arguments = _arguments()
    for folder in (arguments.corpus, HERE / "findings"):
        folder.mkdir(parents=True, exist_ok=True)
    options = [
        f"-max_total_time={arguments.seconds}",
        f"-max_len={arguments.max_len}",
        f"-artifact_prefix={HERE / 'findings'}/{arguments.target}_",
        "-timeout=600",
        f"-rss_limit_mb={2 * _MEBIBYTES}",
        "-print_final_stats=1",
        "-seed=1",
    ]
    folders = [str(arguments.corpus), str(HERE / "corpus" / arguments.target)]
    atheris.Setup(
        [sys.argv[0], *options, *folders], _watched(arguments.target, arguments.max_len, arguments.keep_going)
    )
    atheris.Fuzz()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", choices=targets.TARGETS)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--max-len", type=int, default=32768, help="bytes of the longest input")
    parser.add_argument("--corpus", type=Path, default=HERE / "found", help="what reaches new code is kept there")
    parser.add_argument("--keep-going", action="store_true", help="go on after a finding, but keep one of each kind")
    return parser.parse_args()


def _watched(name: str, max_len: int, keep_going: bool) -> Callable[[bytes], None]:
    """Run the target; an input that fails, hangs, is slow or takes memory is left in `findings`.

    The input is written there through a memory map before it is tried: it stays when the process is killed.
    """
    target, findings = targets.TARGETS[name], HERE / "findings"
    running = findings / f"{name}_running"
    running.write_bytes(bytes(4 + max_len))
    with running.open("r+b") as file:
        current = mmap.mmap(file.fileno(), 0)
    memory_at_start = _peak_mebibytes()

    def run(content: bytes) -> None:
        current[: 4 + len(content)] = len(content).to_bytes(4, "little") + content
        begin = time.process_time()
        try:
            target(content)
            _check(time.process_time() - begin, _peak_mebibytes() - memory_at_start)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            kind = f"{type(error).__name__}_{Path(place.filename).stem}_{place.lineno}"
            (findings / f"{name}_{kind}").write_bytes(content)
            if not keep_going:
                raise

    return run


def _check(seconds: float, mebibytes: float) -> None:
    """Make slow executions findings, by CPU time, since a busy machine slows down by the clock alone; and memory."""
    if seconds > _CPU_SECONDS:
        raise TimeoutError(f"{seconds:.1f} s of CPU time")
    if mebibytes > _MEBIBYTES:
        raise MemoryError(f"{mebibytes:.0f} MiB more than at the start")


def _peak_mebibytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
