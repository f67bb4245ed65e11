# SPDX-License-Identifier: Apache-2.0
"""Scores image by image and set by set: true errors beside the label-free ones."""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cvcdepth_core.comparison import rank_correlation
from cvcdepth_core.consistency import AgreementRow
from cvcdepth_core.metrics import METRIC_NAMES
from cvcdepth_core.scores import ALL, Measurement, Scores, mean

Key = tuple[str, int, str]  # recording, stamp, camera


class LabelFree(NamedTuple):
    """What can be said without truth; NaN where nothing could be compared."""

    spatial: float = math.nan
    """Median relative disagreement with the neighbouring cameras, mean over them."""
    temporal: float = math.nan
    """Median relative disagreement with the same camera one set earlier, by the recorded motion."""
    spatial_photometric: float = math.nan
    """Photometric error of the picture rendered from the neighbours'."""
    temporal_photometric: float = math.nan
    """Photometric error of the picture rendered from the one before."""


class ImageScore(NamedTuple):
    """One camera's picture of one set."""

    recording: str
    stamp_ns: int
    """Of the set."""
    camera: str
    truth_points: int
    coverage: float
    scale: float
    """median(truth) / median(prediction)."""
    metrics: dict[str, float]
    """By `METRIC_NAMES`, depth as predicted."""
    scaled: dict[str, float]
    """The same, scaled by `scale`."""
    label_free: LabelFree


class SetScore(NamedTuple):
    """One set: means over the cameras that have a value."""

    recording: str
    stamp_ns: int
    abs_rel: float
    label_free: LabelFree

    @property
    def rank(self) -> float:
        """The lower the better: the true error, where it is not known the disagreement of cameras; else NaN."""
        return self.label_free.spatial if math.isnan(self.abs_rel) else self.abs_rel


def image_scores(scores: Scores, agreement: Iterable[AgreementRow]) -> list[ImageScore]:
    """Join both kinds of rows."""
    label_free = _label_free_by_image(agreement)
    return [_image_score(row, label_free.get(row.key, LabelFree())) for row in scores.images]


def set_scores(images: Iterable[ImageScore]) -> list[SetScore]:
    """Take the means over the cameras, in the order of the images."""
    by_set: dict[tuple[str, int], list[ImageScore]] = defaultdict(list)
    for image in images:
        by_set[image.recording, image.stamp_ns].append(image)
    return [
        SetScore(recording, stamp, _known_mean([i.metrics["abs_rel"] for i in found]), _mean_label_free(found))
        for (recording, stamp), found in by_set.items()
    ]


def correlations(sets: Sequence[SetScore]) -> dict[str, float]:
    """Return each label-free score's rank correlation with Abs Rel over the sets; NaN where it is undefined."""
    errors = [found.abs_rel for found in sets]
    return {
        name: rank_correlation([getattr(found.label_free, name) for found in sets], errors)
        for name in LabelFree._fields
    }


def to_csv(images: Iterable[ImageScore]) -> str:
    """Return a table with a line per image; numbers as Python writes them, nothing where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    scaled = [f"{name}_median_scaled" for name in METRIC_NAMES]
    plain = ("recording", "stamp_ns", "camera", "truth_points", "coverage", "scale")
    writer.writerow([*plain, *METRIC_NAMES, *scaled, *LabelFree._fields])
    for image in images:
        numbers = [image.coverage, image.scale, *image.metrics.values(), *image.scaled.values(), *image.label_free]
        cells = ["" if math.isnan(number) else repr(number) for number in numbers]
        writer.writerow([image.recording, image.stamp_ns, image.camera, image.truth_points, *cells])
    return text.getvalue()


def _image_score(row: Measurement, label_free: LabelFree) -> ImageScore:
    sums, scaled = (row.sums[scaling].get(ALL) for scaling in ("metric", "median"))
    nothing = dict.fromkeys(METRIC_NAMES, math.nan)
    return ImageScore(
        row.recording,
        row.stamp_ns,
        row.camera,
        sums.truth if sums else 0,
        sums.predicted / sums.truth if sums else math.nan,
        row.scale,
        sums.metrics() if sums else nothing,
        scaled.metrics() if scaled else nothing,
        label_free,
    )


def _label_free_by_image(agreement: Iterable[AgreementRow]) -> dict[Key, LabelFree]:
    found: dict[Key, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in agreement:
        numbers = found[row.recording, row.stamp_ns, row.camera]
        numbers[row.kind].append(row.agreement.median)
        numbers[f"{row.kind}_photometric"].append(row.agreement.photometric)
    return {
        key: LabelFree(*(_known_mean(numbers[name]) for name in LabelFree._fields)) for key, numbers in found.items()
    }


def _mean_label_free(images: Sequence[ImageScore]) -> LabelFree:
    return LabelFree(*(_known_mean(values) for values in zip(*(image.label_free for image in images), strict=True)))


def _known_mean(values: Sequence[float]) -> float:
    return mean([value for value in values if not math.isnan(value)])
