# SPDX-License-Identifier: Apache-2.0
"""Scores image by image and set by set: true errors beside the label-free ones."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.files import write_atomically
from cvcdepth_core.scoring.comparison import rank_correlation
from cvcdepth_core.scoring.consistency import AgreementTable
from cvcdepth_core.scoring.metrics import METRIC_NAMES, metrics_of
from cvcdepth_core.scoring.scores import ALL, Measurements, Scores, mean


class LabelFree(NamedTuple):
    """Scores that need no ground truth; NaN where nothing could be compared."""

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
    number: int
    """Of the recording's sets, from 0."""
    stamp_ns: int
    abs_rel: float
    label_free: LabelFree

    @classmethod
    def from_images(cls, number: int, images: Sequence[ImageScore]) -> SetScore:
        """Return the means over a set's images."""
        means = [_known_mean(values) for values in zip(*(image.label_free for image in images), strict=True)]
        abs_rel = _known_mean([image.metrics["abs_rel"] for image in images])
        return cls(images[0].recording, number, images[0].stamp_ns, abs_rel, LabelFree(*means))

    @property
    def rank(self) -> float:
        """The lower the better: the true error, where it is not known the disagreement of cameras; else NaN."""
        return self.label_free.spatial if math.isnan(self.abs_rel) else self.abs_rel


def image_scores(scores: Scores, agreement: Sequence[AgreementTable]) -> Iterator[list[ImageScore]]:
    """Yield the scores of each set's images, set by set; `agreement` in the order of the scores' recordings."""
    group = scores.settings.groups.index(ALL)
    for table, compared in zip(scores.images, agreement, strict=True):
        label_free = _label_free(compared, len(table), table.cameras)
        for number in range(len(table)):
            yield [
                _image_score(table, number, camera, group, LabelFree(*label_free[number, camera].tolist()))
                for camera in range(len(table.cameras))
            ]


def label_free_by_camera(scores: Scores, agreement: Sequence[AgreementTable]) -> dict[str, LabelFree]:
    """Return each camera's label-free scores, the means over its images that have any."""
    found: dict[str, list[NDArray[np.float64]]] = {}
    for table, compared in zip(scores.images, agreement, strict=True):
        numbers = _label_free(compared, len(table), table.cameras)
        for camera, name in enumerate(table.cameras):
            found.setdefault(name, []).append(numbers[:, camera])
    return {
        name: LabelFree(*(_known_mean(column) for column in np.concatenate(parts).T.tolist()))
        for name, parts in found.items()
    }


def mean_label_free(cameras: Iterable[LabelFree]) -> LabelFree:
    """Return the means over the cameras that have a value."""
    columns = list(zip(*cameras, strict=True)) or [()] * len(LabelFree._fields)
    return LabelFree(*map(_known_mean, columns))


def correlations(sets: Sequence[SetScore]) -> dict[str, float]:
    """Return each label-free score's rank correlation with Abs Rel over the sets; NaN where it is undefined."""
    errors = [found.abs_rel for found in sets]
    return {
        name: rank_correlation([getattr(found.label_free, name) for found in sets], errors)
        for name in LabelFree._fields
    }


def write_csv(path: Path, images: Iterable[ImageScore]) -> None:
    """Write a table with a line per image; numbers as Python writes them, nothing where there is none."""
    scaled = [f"{name}_median_scaled" for name in METRIC_NAMES]
    plain = ("recording", "stamp_ns", "camera", "truth_points", "coverage", "scale")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*plain, *METRIC_NAMES, *scaled, *LabelFree._fields])
    for image in images:
        numbers = [image.coverage, image.scale, *image.metrics.values(), *image.scaled.values(), *image.label_free]
        cells = ["" if math.isnan(number) else repr(number) for number in numbers]
        writer.writerow([image.recording, image.stamp_ns, image.camera, image.truth_points, *cells])
    write_atomically(path, stream.getvalue().encode())


def _image_score(table: Measurements, number: int, camera: int, group: int, label_free: LabelFree) -> ImageScore:
    sums = table.sums[number, camera, :, group]
    truth, predicted = (int(sums[name][0]) for name in ("truth", "predicted"))
    metric, median = (dict(zip(METRIC_NAMES, found, strict=True)) for found in metrics_of(sums).tolist())
    return ImageScore(
        table.recording,
        int(table.stamps_ns[number]),
        table.cameras[camera],
        truth,
        predicted / truth if truth else math.nan,
        float(table.scales[number, camera]),
        metric,
        median,
        label_free,
    )


def _label_free(compared: AgreementTable, sets: int, cameras: Sequence[str]) -> NDArray[np.float64]:
    """Return the numbers [sets, N, 4] of `LabelFree`: of each kind the mean over the others that have a value."""
    columns = compared.columns
    kinds = np.array([kind for kind, _, _ in compared.pairs], dtype=np.str_)
    places = np.array([cameras.index(camera) for _, camera, _ in compared.pairs], dtype=np.int64)
    means = []
    for column in ("median", "photometric"):
        for kind in ("spatial", "temporal"):
            known = columns[(kinds == kind)[columns["pair"]] & ~np.isnan(columns[column])]
            place = known["set"] * np.int64(len(cameras)) + places[known["pair"]]
            total = np.bincount(place, known[column], sets * len(cameras))
            with np.errstate(invalid="ignore"):
                means.append(total / np.bincount(place, minlength=sets * len(cameras)))
    return np.stack(means, axis=-1).reshape(sets, len(cameras), len(LabelFree._fields))


def _known_mean(values: Sequence[float]) -> float:
    return mean([value for value in values if not math.isnan(value)])
