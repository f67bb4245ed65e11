# SPDX-License-Identifier: Apache-2.0
"""Turn or blur one camera of a recording after a while, and see when the overlap monitor names it.

    python tools/overlap_trial.py ../shared/data/pandaset_002

The recording's sets are shown forwards and backwards at 10 Hz. After `--healthy` seconds the camera's picture is turned
by a degree, as by a moved mount, or blurred, and its depth is estimated anew. Prints a Markdown table of the seconds
until the camera is named, in brackets who else was named and when, and what the monitor costs.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.overlap_monitor import OverlapMonitor
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.ground import with_ground
from cvcdepth_ros.recordings.replay import DepthReplay, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings, ModelSettings

PERIOD_NS = 10**8
Change = Callable[[Picture, NDArray[np.float64]], Picture]
"""From a camera's picture and intrinsics to the picture that it would take."""


@dataclass(frozen=True)
class Drive:
    """A recording's sets with their depth."""

    rig: Rig
    estimator: SurroundDepthEstimator
    sets: Sequence[SurroundDepth]

    def changed(self, camera: int, change: Change) -> Drive:
        """Return the drive as it would be with one camera changed."""
        return replace(self, sets=[self._changed_set(surround, camera, change) for surround in self.sets])

    def there_and_back(self) -> Iterator[SurroundDepth]:
        """Give the sets forwards and backwards, for ever."""
        return cycle([*self.sets, *self.sets[-2:0:-1]])

    def _changed_set(self, surround: SurroundDepth, camera: int, change: Change) -> SurroundDepth:
        depth, pictures = surround.depth.copy(), surround.pictures.copy()
        intrinsics = surround.intrinsics[camera]
        pictures[camera] = change(pictures[camera], intrinsics)
        alone = [picture if index == camera else None for index, picture in enumerate(pictures)]
        depth[camera] = self.estimator.estimate(alone).depth[camera]
        return replace(surround, depth=depth, pictures=pictures)


def main() -> None:
    """Try every camera with every change."""
    options = parse_options()
    drive = recorded_drive(options.recording)
    costs: list[float] = []
    print(f"| camera | {' | '.join(CHANGES)} |\n|---|{'---|' * len(CHANGES)}")
    for index, name in enumerate(drive.rig.names):
        cells = [trial(drive, drive.changed(index, change), name, options, costs) for change in CHANGES.values()]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    milliseconds = sorted(1e3 * seconds for seconds in costs)
    p95 = milliseconds[int(0.95 * len(milliseconds))]
    print(f"\n{statistics.median(milliseconds):.1f} ms of CPU time per set, 95th percentile {p95:.1f} ms")


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--healthy", type=float, default=16.0, metavar="S", help="seconds before the change")
    parser.add_argument("--seconds", type=float, default=8.0, metavar="S", help="seconds after the change")
    return parser.parse_args()


def recorded_drive(path: Path) -> Drive:
    """Estimate all of a recording's sets with the package's own model."""
    estimator = ModelSettings().build_estimator()
    with open_recording(path) as recording:
        replay = SurroundReplay(with_ground(RecordedRig.from_recording(recording))[0], MatchingSettings())
        found = list(DepthReplay(replay, estimator).sets())
    rig = found[0].rig
    return Drive(rig, SurroundDepthEstimator(rig, estimator), [estimated.result for estimated in found])


def trial(healthy: Drive, changed: Drive, name: str, options: argparse.Namespace, costs: list[float]) -> str:
    """Return the seconds until the camera was named, and who else was, before or after the change."""
    monitor = OverlapMonitor(healthy.rig)
    begin, end = (round(s * 1e9 / PERIOD_NS) for s in (options.healthy, options.healthy + options.seconds))
    shown = [*islice(healthy.there_and_back(), begin), *islice(changed.there_and_back(), begin, end)]
    named: dict[str, float] = {}
    for number, surround in enumerate(shown):
        began = time.process_time()
        monitor.update(surround, number * PERIOD_NS)
        costs.append(time.process_time() - began)
        for finding in monitor.findings():
            named.setdefault(" or ".join(finding.cameras), (number - begin) * PERIOD_NS / 1e9)
    return outcome(named, name)


def outcome(named: dict[str, float], name: str) -> str:
    """Say after how many seconds a camera was named, and when others were; negative: before the change."""
    when = min((seconds for who, seconds in named.items() if name in who.split(" or ")), default=None)
    others = ", ".join(f"{who} at {seconds:.1f}" for who, seconds in named.items() if who != name)
    found = "**not found**" if when is None else f"{when:.1f}"
    return f"{found} ({others})" if others else found


def turned(axis: int) -> Change:
    """Return what turns a camera by a degree about its x (0) or y (1) axis."""
    rotation = cv2.Rodrigues(np.radians(np.eye(3)[axis]))[0]

    def change(picture: Picture, intrinsics: NDArray[np.float64]) -> Picture:
        homography = intrinsics @ rotation @ np.linalg.inv(intrinsics)
        size = (picture.shape[1], picture.shape[0])
        warped = cv2.warpPerspective(picture, homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, np.uint8)

    return change


def blurred(picture: Picture, _: NDArray[np.float64]) -> Picture:
    """Blur by a sigma of one pixel of the network."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.0), np.uint8)


CHANGES: dict[str, Change] = {"yaw 1 degree": turned(1), "pitch 1 degree": turned(0), "blurred": blurred}


if __name__ == "__main__":
    main()
