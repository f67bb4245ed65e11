# SPDX-License-Identifier: Apache-2.0
"""Feed the node at 10 Hz for minutes or hours, with random faults every few seconds, and watch what it keeps.

    python tools/soak.py --minutes 60 --output output/soak.json

The faults are those of tests/support/camera_faults.py: first each at all cameras at once, so that whatever is kept for
it is kept before memory is compared, then at one or two cameras for some seconds, as `--seed` decides. The run fails
when the node ends, when its memory grows by more than 2 % after five minutes (or after a third of a shorter run), when
its files or threads become more, or when a depth image carries a stamp that its camera has not sent, or one twice.
"""

import argparse
import json
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from camera_faults import FAULTS  # noqa: E402
from camera_scene import DEPTH, Scene, running_scene, stamp_of  # noqa: E402
from recordings import CAMERAS  # noqa: E402

SETTLED = 300.0
"""Seconds until memory has to stay as it is."""
GROWTH = 0.02
"""Of resident memory, from the first quarter of the settled time to the last."""
FIRST_ROUND = 1.5
"""Seconds for each fault while all cameras have it; with all faults less than a third of three minutes."""
PERIOD = 0.1
KEPT_STAMPS = 1000


@dataclass
class Soak:
    """What was seen so far."""

    seed: int
    seconds: float = 0.0
    sets_sent: int = 0
    depth_images: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    wrong_stamps: list[str] = field(default_factory=list)
    samples: list[tuple[float, float, int, int]] = field(default_factory=list)
    """Seconds, resident MiB, open files, threads."""

    def problems(self, warm_up: float) -> list[str]:
        """Say what must not be."""
        settled = [sample for sample in self.samples if sample[0] >= warm_up]
        if len(settled) < 2 * _QUARTER:
            return [f"only {len(settled)} measurements after the warm-up of {warm_up:.0f} s"]
        first, last = settled[: len(settled) // _QUARTER], settled[-len(settled) // _QUARTER :]
        growth = _median([s[1] for s in last]) / _median([s[1] for s in first]) - 1
        found = list(self.wrong_stamps[:5])
        if growth > GROWTH:
            found.append(f"resident memory grew by {growth:.1%}")
        for index, name in ((2, "open files"), (3, "threads")):
            before, after = _median([s[index] for s in first]), _median([s[index] for s in last])
            if after > before:
                found.append(f"{name} grew from {before:.0f} to {after:.0f}")
        return found if self.depth_images else [*found, "no depth image was published"]


_QUARTER = 4


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write the result, and return 1 when something was wrong."""
    options = _options(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # or the node would outlive this, in a domain that is free
    with tempfile.TemporaryDirectory() as folder, running_scene(Path(folder)) as scene:
        soak = _run(scene, options.minutes * 60, random.Random(options.seed), Soak(options.seed))
    problems = soak.problems(min(SETTLED, options.minutes * 60 / 3))
    result = vars(soak) | {"problems": problems}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1))
    faults = sum(soak.faults.values())
    print(f"{soak.seconds:.0f} s, {faults} faults, {soak.depth_images} depth images: {problems or 'fine'}")
    return 1 if problems else 0


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("output/soak.json"))
    return parser.parse_args(arguments)


def _run(scene: Scene, seconds: float, choose: random.Random, soak: Soak) -> Soak:
    begin = time.monotonic()
    change_at, due, next_sample = begin, begin, begin
    schedule = _schedule(choose)
    seen: dict[str, list[int]] = {name: [] for name in CAMERAS}
    while (now := time.monotonic()) - begin < seconds:
        if scene.node.poll() is not None:
            soak.wrong_stamps.append(f"the node ended with {scene.node.poll()}: {scene.graph.log()[-500:]}")
            break
        if now >= change_at:
            faults, duration = next(schedule)
            scene.inject(**{camera: FAULTS[name] for camera, name in faults.items()})
            soak.faults.update(faults.values())
            change_at = now + duration
        scene.cameras.cycle()
        soak.sets_sent += 1
        due = max(due + PERIOD, now)
        scene.graph.spin(max(0.001, due - time.monotonic()))
        _check_stamps(scene, seen, soak)
        if now >= next_sample:
            soak.samples.append((now - begin, *scene.node.resources()))
            next_sample = now + 1.0
    soak.seconds = time.monotonic() - begin
    return soak


def _schedule(choose: random.Random) -> Iterator[tuple[dict[str, str], float]]:
    """Say without end which camera has which fault, and for how many seconds."""
    for name in FAULTS:
        yield dict.fromkeys(CAMERAS, name), FIRST_ROUND
    while True:
        cameras = choose.sample(CAMERAS, choose.choice([0, 1, 1, 2]))
        yield {camera: choose.choice(list(FAULTS)) for camera in cameras}, choose.uniform(1.0, 6.0)


def _check_stamps(scene: Scene, seen: dict[str, list[int]], soak: Soak) -> None:
    """Trace every depth image to the one image of its camera with that stamp, and forget what is long past."""
    for name, topic in DEPTH.items():
        for message in scene.graph.received[topic]:
            stamp = stamp_of(message)
            soak.depth_images += 1
            if stamp not in scene.cameras.sent[name] or stamp in seen[name]:
                soak.wrong_stamps.append(
                    f"depth of {name} at {stamp} ns: " + ("twice" if stamp in seen[name] else "never sent")
                )
            seen[name] = [*seen[name][-KEPT_STAMPS:], stamp]
        scene.graph.received[topic].clear()
        newest = sorted(scene.cameras.sent[name])[-KEPT_STAMPS:]
        scene.cameras.sent[name] = (
            set(newest) if len(scene.cameras.sent[name]) > 2 * KEPT_STAMPS else scene.cameras.sent[name]
        )
    for topic in set(scene.graph.received) - set(DEPTH.values()):
        del scene.graph.received[topic][:-1]


def _median(values: Sequence[float]) -> Any:
    return sorted(values)[len(values) // 2]


if __name__ == "__main__":
    sys.exit(main())
