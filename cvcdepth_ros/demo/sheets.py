# SPDX-License-Identifier: Apache-2.0
"""The demo's pictures: a contact sheet for every set that arrived, and the page that plays them."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from cvcdepth_core.errors import TransformError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.visualization import Points, SurroundPictures, contact_sheet
from cvcdepth_ros.demo.recorded_lidar import RecordedLidar
from cvcdepth_ros.demo.result import UNTRAINED_WARNING, DemoResult
from cvcdepth_ros.end_to_end.received import ReceivedSet
from cvcdepth_ros.reports.animation_page import Table, animation_page
from cvcdepth_ros.reports.style import to_jpeg

_PNG_COMPRESSION = 6


class SheetWriter:
    """Draws sets, writes each as PNG, and keeps a JPEG of each for the page."""

    def __init__(self, rig: Rig, lidar: RecordedLidar, folder: Path, notes: list[str], untrained: bool) -> None:
        """Draw sets of one rig and recording into `folder`, with `notes` as the last lines below each."""
        self._rig = rig
        self._lidar = lidar
        self._folder = folder
        self._notes = notes
        self._untrained = untrained
        self.jpegs: list[bytes] = []

    def write(self, received: Iterable[ReceivedSet], total: int) -> Iterator[Path]:
        """Draw one set after the other and give the files; `total` is the number of sets that were sent."""
        for surround in received:
            sheet = self._draw(surround, total)
            path = self._folder / f"set_{surround.sent.sequence + 1:03d}.png"
            path.write_bytes(_png(sheet))
            self.jpegs.append(to_jpeg(sheet))
            yield path

    def page(self, title: str, result: DemoResult) -> str:
        """Return the HTML page with all sets that were drawn, and the result's tables."""
        tables: list[Table] = [("What became of it", result.counts()), ("Latency, ms: p50, p95", result.latencies())]
        return animation_page(title, UNTRAINED_WARNING if self._untrained else "", self.jpegs, tables, self._notes)

    def _draw(self, surround: ReceivedSet, total: int) -> Picture:
        stamp = surround.sent.stamp_ns
        points, note = self._sweep(surround)
        shown = SurroundPictures(
            surround.pictures,
            surround.depth,
            surround.cloud,
            points,
            title=f"Surround depth, computed live: set {surround.sent.sequence + 1} of {total}",
            captions=[f"{note}; stamp {stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}", *self._notes],
            warning=UNTRAINED_WARNING if self._untrained else "",
        )
        return contact_sheet(self._rig, shown)

    def _sweep(self, surround: ReceivedSet) -> tuple[Points | None, str]:
        """Return the LiDAR's points at the set's stamp, and what the caption says of them."""
        seen = "Right: the scene from above, grid 10 m; the merged cloud in its own colours, brightened"
        try:
            points = self._lidar.at(surround.sent.time_ns, surround.sent.images[self._rig.anchor])
        except TransformError as error:
            return None, f"{seen}, no LiDAR ({error})"
        return points, f"{seen}, {'LiDAR in cyan' if points is not None else 'no LiDAR recorded'}"


def _png(picture: Picture) -> bytes:
    options = [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]), options)
    return bytes(encoded)
