# SPDX-License-Identifier: Apache-2.0
"""Decoding and rectification on threads of their own, while a set is still incomplete. No ROS here.

Work is only ahead of need, never a backlog: of each camera at most one image waits, the newest, and whoever needs a
picture that is not ready makes it on the spot.
"""

import os
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.set_estimation import EncodedImage, Outcome, picture_or_error

_MOST_THREADS = 4


class CameraImage:
    """One image message on its way to the network's picture, which is made once, by the first who asks."""

    def __init__(self, camera: str, image: EncodedImage, latencies: StageLatencies) -> None:
        """Take the image over; it is let go as soon as the picture is there."""
        self.camera = camera
        self.received = time.monotonic()
        self._image: EncodedImage | None = image
        self._latencies = latencies
        self._rectifier: Rectifier | None = None
        self._picture: Outcome | None = None
        self._lock = threading.Lock()

    def picture(self, rectifier: Rectifier) -> Outcome:
        """Return the picture, or an error when it is damaged or was made with maps of another calibration."""
        with self._lock:
            if self._picture is None and self._image is not None:
                self._picture = picture_or_error(self._image, self.camera, rectifier, self._latencies)
                self._rectifier, self._image = rectifier, None
        if self._picture is None or self._rectifier is not rectifier:
            return ImageError(f"camera {self.camera}: its calibration changed while its image waited")
        return self._picture


class PicturePreparer:
    """The threads that make pictures."""

    def __init__(self, cameras: int) -> None:
        threads = min(cameras, _MOST_THREADS, len(os.sched_getaffinity(0)))
        self.pool = ThreadPoolExecutor(threads, thread_name_prefix="prepare")
        self._waiting: dict[str, Future[Outcome]] = {}

    def prepare(self, image: CameraImage, rectifier: Rectifier) -> None:
        """Make the picture soon, in place of its camera's former image if that one is still waiting."""
        former = self._waiting.get(image.camera)
        if former is not None:
            former.cancel()
        self._waiting[image.camera] = self.pool.submit(image.picture, rectifier)

    def pictures(self, images: Mapping[str, CameraImage], rectifiers: Mapping[str, Rectifier]) -> dict[str, Outcome]:
        """Return every image's picture, or what is wrong with it, by camera."""
        futures = {name: self.pool.submit(image.picture, rectifiers[name]) for name, image in images.items()}
        return {name: future.result() for name, future in futures.items()}

    def close(self) -> None:
        """Drop what waits."""
        self.pool.shutdown(wait=False, cancel_futures=True)
