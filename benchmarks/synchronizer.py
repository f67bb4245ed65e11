# SPDX-License-Identifier: Apache-2.0
"""Cost of the synchroniser for eight cameras at 60 Hz: `python benchmarks/synchronizer.py`.

The baseline is what a plain approximate-time matcher does: on every arrival try the combinations of queued images, the
nearest first, until one fits the tolerance. Both get the same stream in the same run.
"""

import itertools
import random

from measuring import json_lines, measure_in_turns, print_line

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.surround_sets.synchronizer import SurroundSynchronizer

CAMERAS = [f"camera{i}" for i in range(8)]
RATE = 60  # Hz
TOLERANCE = 0.008  # s
SECONDS = 60
REPEATS = 5

Stream = list[tuple[str, int]]


class ApproximateTimeScan:
    """The baseline: no anchor, no clock model, the first combination within the tolerance."""

    def __init__(self, queue_size: int = 10) -> None:
        self.sets = 0
        self._queues: dict[str, dict[int, None]] = {camera: {} for camera in CAMERAS}
        self._queue_size = queue_size
        self._tolerance = round(TOLERANCE * NANOSECONDS)

    def add(self, camera: str, stamp: int, image: None) -> None:
        """Queue the image and remove the first combination that fits."""
        queue = self._queues[camera]
        queue[stamp] = image
        if len(queue) > self._queue_size:
            del queue[min(queue)]
        near = []
        for others in self._queues.values():
            within = [s for s in others if abs(s - stamp) <= self._tolerance]
            if not within:
                return
            near.append(sorted(within, key=lambda s: abs(s - stamp)))
        for combination in itertools.product(*near):
            if max(combination) - min(combination) <= self._tolerance:
                self.sets += 1
                for name, used in zip(CAMERAS, combination, strict=True):
                    del self._queues[name][used]
                return


def eight_cameras() -> Stream:
    """In phase within 2 ms, 1 ms of jitter."""
    rng = random.Random(0)
    phases = {camera: rng.uniform(-2e-3, 2e-3) for camera in CAMERAS}
    stream = [
        (camera, round((1 + cycle / RATE + phases[camera] + rng.uniform(-1e-3, 1e-3)) * NANOSECONDS))
        for cycle in range(SECONDS * RATE)
        for camera in CAMERAS
    ]
    return sorted(stream, key=lambda arrival: arrival[1])


def run(matcher: SurroundSynchronizer[None] | ApproximateTimeScan, stream: Stream) -> None:
    for camera, stamp in stream:
        matcher.add(camera, stamp, None)


def synchronizer(min_cameras: int = 0) -> SurroundSynchronizer[None]:
    return SurroundSynchronizer(CAMERAS, CAMERAS[0], TOLERANCE, min_cameras=min_cameras)


def main() -> None:
    stream = eight_cameras()
    one_dead = [arrival for arrival in stream if arrival[0] != CAMERAS[-1]]
    cases = {
        "first combination that fits": lambda: run(ApproximateTimeScan(), stream),
        "ours": lambda: run(synchronizer(), stream),
        "ours, one camera dead": lambda: run(synchronizer(), one_dead),
        "ours, one camera dead, min_cameras 6": lambda: run(synchronizer(min_cameras=6), one_dead),
    }
    timings = measure_in_turns(cases, REPEATS)
    sizes = {"cameras": len(CAMERAS), "rate_hz": RATE, "stream_s": SECONDS}
    for line in json_lines("synchronizer", timings, "first combination that fits", sizes):
        share = line["cpu_ms"] / (1e3 * SECONDS)
        print_line(line | {"core_share_percent": round(100 * share, 3)})


if __name__ == "__main__":
    main()
