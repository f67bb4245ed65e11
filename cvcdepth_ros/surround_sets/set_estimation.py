# SPDX-License-Identifier: Apache-2.0
"""From the image messages of one set to depth, for the bag tool and the evaluation, and the live node's part of it."""

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.images.decoding import Picture, Reduction
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.refinement.drive import VisualMotion
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

T = TypeVar("T")

Outcome = Picture | ImageError
"""Result of preparing one image: the network's picture, or why there is none."""


@dataclass(frozen=True, eq=False)
class EstimatedSet(Generic[T]):
    """A surround set, its depth, and the rig that it was estimated with."""

    surround_set: SurroundSet[T]
    rig: Rig
    """As it was at this set: calibrations may change meanwhile."""
    result: SurroundDepth
    """Arrays in the order of the rig's cameras."""
    visual: VisualMotion | None = None
    """What the pictures tell of the vehicle's motion; None where they were not followed."""
    world_T_base: NDArray[np.float64] | None = None
    """[N, 4, 4] where the vehicle was at each exposure; None where nobody asked for it, or it is not known."""


def estimate_set(
    messages: Mapping[str, Any], surround: SurroundDepthEstimator, latencies: StageLatencies, required: int
) -> SurroundDepth:
    """Decode, rectify and estimate the image messages of one set, by camera; those that are damaged are left out.

    Raises ImageError, naming what is wrong with them, when fewer than `required` images are left.
    """
    rectifiers = surround.preprocessor.rectifiers
    images = images_of(messages)
    outcomes = {
        name: picture_or_error(images[name], name, rectifier, latencies)
        for name, rectifier in rectifiers.items()
        if name in images
    }
    pictures = usable_pictures(outcomes, len(messages), required)
    with latencies.measure("inference"):
        return surround.estimate([pictures.get(name) for name in rectifiers])


def usable_pictures(outcomes: Mapping[str, Outcome], cameras: int, required: int) -> dict[str, Picture]:
    """Return the pictures that were made; ImageError when the others leave fewer than `required` of `cameras`."""
    damaged = [str(outcome) for outcome in outcomes.values() if isinstance(outcome, ImageError)]
    if cameras - len(damaged) < required:
        raise ImageError("; ".join(damaged) or f"{cameras} calibrated cameras are fewer than {required}")
    return {name: outcome for name, outcome in outcomes.items() if not isinstance(outcome, ImageError)}


class EncodedImage:
    """An image message, decoded once for all the cameras that are views of its lens. Thread-safe."""

    def __init__(self, message: Any, is_shared: bool = False) -> None:
        """Where it is not shared, the picture is not kept."""
        self._message = message
        self._is_shared = is_shared
        self._pictures: dict[Reduction, Picture] = {}
        self._lock = threading.Lock()

    def decoded(self, camera: str, rectifier: Rectifier) -> Picture:
        """Return the picture, reduced as the rectifier takes it; ImageError as for `picture_from_message`."""
        reduction = rectifier.reduction
        if not self._is_shared:
            return picture_from_message(self._message, camera, reduction, rectifier.image_size)
        with self._lock:
            if reduction not in self._pictures:
                picture = picture_from_message(self._message, camera, reduction, rectifier.image_size)
                self._pictures[reduction] = picture
            return self._pictures[reduction]


def images_of(messages: Mapping[str, Any]) -> dict[str, EncodedImage]:
    """Return each camera's image; cameras that have the very same message share it."""
    uses = Counter(map(id, messages.values()))
    images = {id(message): EncodedImage(message, uses[id(message)] > 1) for message in messages.values()}
    return {name: images[id(message)] for name, message in messages.items()}


def picture_or_error(image: EncodedImage, camera: str, rectifier: Rectifier, latencies: StageLatencies) -> Outcome:
    """Take one image to the network's picture.

    The error names the camera whose image is damaged, of an unknown encoding, or not of the calibration's size.
    """
    try:
        with latencies.measure("decode"):
            picture = image.decoded(camera, rectifier)
        with latencies.measure("preprocess"):
            return rectifier(picture, camera, rectifier.reduction)
    except ImageError as error:
        return error
    except Exception as error:  # what OpenCV raises has no end, and one image must not cost the others of its set
        return ImageError(f"camera {camera}: {type(error).__name__}: {error}")
