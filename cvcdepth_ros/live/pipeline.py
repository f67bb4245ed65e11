# SPDX-License-Identifier: Apache-2.0
"""From images to published depth, each step on a thread of its own so that none waits for another. No ROS here.

    receive (caller) -> decode and rectify (pool) -> estimate (one thread, newest set wins) -> publish (one thread)

Nothing piles up: of each camera one image waits to be decoded, one set to be estimated, one estimate to be published.
What nobody wants is not computed, but for packets of video, which are all decoded beside that (`video_streams`).
"""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from cvcdepth_core.errors import CvcDepthError, EngineError, ImageError
from cvcdepth_core.estimator import DepthPredictor, PictureSize, SurroundDepthEstimator
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.rig import Rig
from cvcdepth_ros.live.camera_states import CameraWatch
from cvcdepth_ros.live.mailbox import Mailbox
from cvcdepth_ros.live.picture_preparation import CameraImage, PicturePreparer
from cvcdepth_ros.live.video_streams import VideoImage, VideoStreams
from cvcdepth_ros.messages.conversion import is_video_packet, stamp_ns
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.refinement import RefinementStage
from cvcdepth_ros.surround_sets.set_estimation import EncodedImage, EstimatedSet, usable_pictures
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet, SurroundSynchronizer

_JOIN_SECONDS = 1.0


@dataclass(frozen=True, eq=False)
class _Build:
    """What became of a rig."""

    surround: SurroundDepthEstimator | None
    """For the cameras that can be used; None where those are fewer than a set needs."""
    problems: Mapping[str, str]
    """Why the other cameras cannot, by name."""


class SurroundPipeline:
    """Runs from construction until `close`."""

    def __init__(
        self,
        estimator: DepthPredictor,
        synchroniser: SurroundSynchronizer[CameraImage],
        mailbox: Mailbox[CameraImage],
        watches: Mapping[str, CameraWatch],
        wanted: Callable[[str], bool],
        publish: Callable[[EstimatedSet[CameraImage]], None],
        observe: Callable[[EstimatedSet[CameraImage]], None],
        latencies: StageLatencies,
        refinement: RefinementStage,
    ) -> None:
        """Start the threads.

        `watches` has every camera; `wanted` says whether a camera's depth is. `publish`, and `observe` for what has
        been published, are called on a thread of their own.
        """
        self._estimator = estimator
        self._synchroniser = synchroniser
        self._mailbox = mailbox
        self._watches = watches
        self._wanted = wanted
        self._publish = publish
        self._observe = observe
        self._latencies = latencies
        self._refinement = refinement
        self._rig: Rig | None = None
        self._build: Future[_Build] | None = None
        self._builds: list[Future[_Build]] = []
        self._last_built: SurroundDepthEstimator | None = None
        self._pace = _InferencePace()
        self._warming = threading.Lock()
        self._warm: DepthPredictor | None = None
        self._videos = VideoStreams()
        self._preparer = PicturePreparer(len(watches))
        self._estimates: queue.Queue[EstimatedSet[CameraImage] | None] = queue.Queue(maxsize=1)
        self.problem = ""
        """Why the last set could not be estimated or published; empty when it could."""
        self.counters = Counter(
            {"published": 0, "skipped: rig not complete": 0, "skipped: no subscriber": 0, "refused": 0}
        )
        self._threads = [
            threading.Thread(target=self._estimate_sets, name="inference", daemon=True),
            threading.Thread(target=self._publish_sets, name="publish", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def rig_problems(self) -> Mapping[str, str]:
        """Why cameras of the rig that was set cannot be used, by camera; empty while it is not built yet."""
        build = self._build
        if build is None or not build.done() or build.cancelled():
            return {}
        error = build.exception()
        return dict.fromkeys(self._watches, str(error)) if error else build.result().problems

    def set_rig(self, rig: Rig | None) -> None:
        """Use these calibrations and cameras from now on; None: no set can be used until there is a rig again."""
        self._rig = rig
        self._use(None if rig is None else self._preparer.pool.submit(self._build_and_warm_up, rig, self._estimator))

    def set_model(self, estimator: DepthPredictor) -> None:
        """Use another network from the next set on; it is warmed up here, while the former one still runs.

        EngineError when it cannot run: then the former one stays.
        """
        if self._rig is not None:
            build = self._build_surround(self._rig, estimator)
            self._warm_up(build.surround)
            self._last_built = build.surround or self._last_built
            built: Future[_Build] = Future()
            built.set_result(build)
            self._use(built)
        self._estimator = estimator

    def add(self, cameras: Sequence[str], message: Any) -> None:
        """Take an image message or a packet of video in, of a camera or of all that are views of one lens; quick."""
        stamp, content = stamp_ns(message), message.data
        if is_video_packet(message):
            message = self._video_image(cameras, message)  # whatever becomes of it, later packets are built on it
        image = EncodedImage(message, is_shared=len(cameras) > 1)
        for camera in cameras:
            if self._watches[camera].accept(stamp, content) and message is not None:
                self._add(CameraImage(camera, image, self._latencies), stamp)

    def _add(self, image: CameraImage, stamp: int) -> None:
        self._prepare_ahead([image])
        for surround_set in self._synchroniser.add(image.camera, stamp, image):
            self._mailbox.put(surround_set)
            self._prepare_ahead(surround_set.images.values())

    def _video_image(self, cameras: Sequence[str], packet: Any) -> VideoImage | None:
        try:
            return self._videos.take(cameras[0], packet)
        except ImageError as error:
            for camera in cameras:
                self._watches[camera].used(str(error))
            return None

    def close(self) -> bool:
        """Stop; False when a thread is still inside its last set a second later."""
        self._mailbox.close()
        self._videos.close()
        self._preparer.close()
        deadline = time.monotonic() + _JOIN_SECONDS
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        building = [build for build in self._builds if build.running()]  # a warm-up may compile for minutes
        wait(building, max(0.0, deadline - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads) and all(build.done() for build in building)

    def _use(self, build: Future[_Build] | None) -> None:
        former, self._build = self._build, build
        self._builds = [b for b in (*self._builds, build) if b is not None and not b.done()]
        if former is not None:
            former.cancel()  # whoever sends new calibrations faster than maps can be built piles nothing up

    def _prepare_ahead(self, images: Iterable[CameraImage]) -> None:
        """Have pictures made while the network works on another set.

        An image whose set will be replaced before the network is free need not be decoded. When it arrives, that is
        not known yet; when its set is complete, what comes next is a camera's interval away.
        """
        build = self._build
        surround = _surround_of(build) if build is not None and build.done() else None
        if surround is None:
            return
        rectifiers = surround.preprocessor.rectifiers
        soon = {i.camera: i for i in images if self._pace.is_free_within(self._watches[i.camera].interval)}
        for camera in self._needed(soon, surround):
            if camera in rectifiers:
                self._preparer.prepare(soon[camera], rectifiers[camera])

    def _build_and_warm_up(self, rig: Rig, estimator: DepthPredictor) -> _Build:
        build = self._build_surround(rig, estimator)
        self._last_built = build.surround or self._last_built
        with suppress(EngineError):  # the first set will tell
            self._warm_up(build.surround)
        return build

    def _build_surround(self, rig: Rig, estimator: DepthPredictor) -> _Build:
        """Build the maps, taking over those of the cameras that have not changed."""
        try:
            return _Build(SurroundDepthEstimator(rig, estimator, self._last_built), {})
        except Exception:
            problems = _camera_problems(rig, estimator.spec)
            if not problems:
                raise
        usable = [name for name in rig.names if name not in problems]
        if len(usable) < self._synchroniser.required:
            return _Build(None, problems)
        return _Build(SurroundDepthEstimator(rig.only(usable), estimator, self._last_built), problems)

    def _warm_up(self, surround: SurroundDepthEstimator | None) -> None:
        """Have done what an engine does but once, unless it is; EngineError when it cannot run."""
        with self._warming:
            if surround is not None and self._warm is not surround.estimator:
                surround.warm_up()
                self._warm = surround.estimator

    def _estimate_sets(self) -> None:
        while not self._mailbox.closed:
            surround_set = self._mailbox.get()
            if surround_set is not None:
                self._guard(self._estimate, surround_set)
        self._estimates.put(None)

    def _publish_sets(self) -> None:
        while (estimated := self._estimates.get()) is not None:
            self._guard(self._hand_out, estimated)

    def _guard(self, work: Callable[[Any], None], argument: Any) -> None:
        """One bad set must not end the stream; its reason is kept."""
        try:
            work(argument)
        except CvcDepthError as error:
            self._refuse(str(error))
        except Exception as error:
            if not self._mailbox.closed:
                self._refuse(f"{type(error).__name__}: {error}")

    def _refuse(self, reason: str) -> None:
        self.counters["refused"] += 1
        self.problem = reason

    def _estimate(self, surround_set: SurroundSet[CameraImage]) -> None:
        surround = self._usable_surround()
        if surround is None:
            self.counters["skipped: rig not complete"] += 1
            return
        rectifiers = surround.preprocessor.rectifiers
        images = {name: image for name, image in surround_set.images.items() if name in rectifiers}
        needed = {name: images[name] for name in self._needed(images, surround)}
        for name in images.keys() - needed.keys():
            self._watches[name].used("")  # nothing is known against an image that nobody looks at
        if not needed:
            self.counters["skipped: no subscriber"] += 1
            return
        received = [image.received for image in surround_set.images.values()]
        self._latencies.record("wait for set", max(received) - min(received))
        self._latencies.record("wait for inference", time.monotonic() - max(received))
        pictures = self._pictures(needed, rectifiers, len(images))
        with self._pace.measured():
            with self._latencies.measure("inference"):
                result = surround.estimate([pictures.get(name) for name in rectifiers])
            estimated = self._refinement.finished(surround, surround_set, result)
        self._estimates.put(estimated)

    def _needed(self, cameras: Iterable[str], surround: SurroundDepthEstimator) -> list[str]:
        """Return which of the cameras' pictures the network needs for the depth that is wanted.

        One that looks at all cameras together must see them all for any, and so must refinement: whoever subscribes to
        one camera gets what whoever subscribes to all gets.
        """
        if surround.estimator.independent and not self._refinement.is_active:
            return [name for name in cameras if self._wanted(name)]
        return list(cameras) if any(map(self._wanted, self._watches)) else []

    def _usable_surround(self) -> SurroundDepthEstimator | None:
        """Wait for the rig that was set; None where there is none, or it cannot be used."""
        build, surround = None, None
        while build is not self._build:  # another may have taken its place meanwhile
            build = self._build
            surround = _surround_of(build) if build is not None else None
        return surround

    def _pictures(
        self, needed: Mapping[str, CameraImage], rectifiers: Mapping[str, Rectifier], cameras: int
    ) -> dict[str, Picture]:
        """Return the needed pictures that can be made; ImageError when fewer of `cameras` are left than a set needs."""
        with self._latencies.measure("wait for pictures"):
            outcomes = self._preparer.pictures(needed, rectifiers)
        for name, outcome in outcomes.items():
            self._watches[name].used(str(outcome) if isinstance(outcome, ImageError) else "")
        return usable_pictures(outcomes, cameras, self._synchroniser.required)

    def _hand_out(self, estimated: EstimatedSet[CameraImage]) -> None:
        self._publish(estimated)
        newest = max(image.received for image in estimated.surround_set.images.values())
        self._latencies.record("newest image to published", time.monotonic() - newest)
        self.counters["published"] += 1
        self.problem = ""
        self._observe(estimated)


def _surround_of(build: Future[_Build]) -> SurroundDepthEstimator | None:
    """Wait for the build; None for one that failed or was cancelled."""
    try:
        return build.result().surround
    except Exception:  # rig_problems tells
        return None


def _camera_problems(rig: Rig, size: PictureSize) -> dict[str, str]:
    """Say for each camera whose maps cannot be built why."""
    found = {}
    for name in rig.names:
        try:
            SurroundPreprocessor(rig.only([name]), size.height, size.width)
        except CvcDepthError as error:
            found[name] = str(error)
        except Exception as error:
            found[name] = f"{type(error).__name__}: {error}"
    return found


class _InferencePace:
    """Foresees when the network will be free, by the time that it took last."""

    def __init__(self) -> None:
        self._busy_until = 0.0
        self._seconds = 0.0

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Take note of how long the block takes."""
        start = time.monotonic()
        self._busy_until = start + self._seconds
        yield
        self._busy_until = time.monotonic()
        self._seconds = self._busy_until - start

    def is_free_within(self, seconds: float) -> bool:
        """Whether the running inference, if any, should be over in so many seconds."""
        return self._busy_until - time.monotonic() <= seconds
