# SPDX-License-Identifier: Apache-2.0
"""Cost of the synchroniser for eight cameras at 60 Hz, as one line of JSON: `python benchmarks/synchronizer.py`.

The baseline is what a plain approximate-time matcher does: on every arrival try the combinations of queued images, the
nearest first, until one fits the tolerance. Both get the same stream in the same run.
"""

import itertools
import json
import platform
import random
import time
from collections.abc import Callable

from cvcdepth_ros.synchronizer import NANOSECONDS, SurroundSynchronizer

CAMERAS = [f"camera{i}" for i in range(8)]
RATE = 60  # Hz
TOLERANCE = 0.008  # s
SECONDS = 60
REPEATS = 5

Stream = list[tuple[str, int]]
Add = Callable[[str, int, None], object]


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


def microseconds_per_image(add: Add, stream: Stream) -> float:
    start = time.perf_counter()
    for camera, stamp in stream:
        add(camera, stamp, None)
    return (time.perf_counter() - start) / len(stream) * 1e6


def synchronizer() -> SurroundSynchronizer[None]:
    return SurroundSynchronizer(CAMERAS, CAMERAS[0], TOLERANCE)


def main() -> None:
    stream = eight_cameras()
    one_dead = [arrival for arrival in stream if arrival[0] != CAMERAS[-1]]
    check, scan = synchronizer(), ApproximateTimeScan()
    microseconds_per_image(check.add, stream)
    microseconds_per_image(scan.add, stream)
    ours = min(microseconds_per_image(synchronizer().add, stream) for _ in range(REPEATS))
    ours_one_dead = min(microseconds_per_image(synchronizer().add, one_dead) for _ in range(REPEATS))
    baseline = min(microseconds_per_image(ApproximateTimeScan().add, stream) for _ in range(REPEATS))
    figures = {
        "benchmark": "synchronizer",
        "machine": f"{platform.machine()} {platform.system()} {platform.processor()}".strip(),
        "python": platform.python_version(),
        "cameras": len(CAMERAS),
        "rate_hz": RATE,
        "images": len(stream),
        "sets": check.statistics().sets,
        "us_per_image": round(ours, 2),
        "core_share_percent": round(ours * len(CAMERAS) * RATE / 1e4, 3),
        "one_dead_camera_us_per_image": round(ours_one_dead, 2),
        "baseline_sets": scan.sets,
        "baseline_us_per_image": round(baseline, 2),
        "ratio_to_baseline": round(ours / baseline, 2),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
