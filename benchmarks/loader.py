# SPDX-License-Identifier: Apache-2.0
"""How fast training samples come straight from a recording, against the time of the JPEG decodes alone.

    .venv/bin/python benchmarks/loader.py [--recording ../shared/data/pandaset_002] [--workers 2] [--rounds 5]

A sample is three sets of six pictures; the cache is off, so every picture of every sample is read, decoded, rectified
and resized anew. All cases go over the same samples with as many worker processes, in turns: "decodes" only decodes
them, at full resolution, from memory; "reduced decodes" does so at the resolution that the loader decodes at.
`mb_after_epochs` is how large this process and its workers were after each of some more epochs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import torch
from measuring import json_lines, measure_in_turns, print_line
from torch.utils.data import DataLoader, Dataset

from cvcdepth_core.images.decoding import Reduction, decode_compressed
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.config import OptimizerConfig, RecordingsConfig, TrainingConfig
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import RecordingIndex, load_index
from cvcdepth_ros.training_data.loader import RecordingBatches
from cvcdepth_ros.training_data.samples import SampleReader

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"


def main() -> None:
    options = parse_options()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        index = load_index(options.recording, Path(folder), MatchingSettings())
    batches = RecordingBatches([index], configuration(options))
    sizes: dict[str, object] = {
        "samples": batches.samples,
        "pictures": len(index.layout.cameras) * 3,
        "workers": options.workers,
    }
    sizes |= {"recording": options.recording.name, "network": f"{options.height}x{options.width}"}
    timings = measure_in_turns(cases(options, index, batches), options.rounds)
    sizes["mb_after_epochs"] = memory_of_epochs(batches, options.epochs)
    for line in json_lines("loader", timings, "decodes", sizes):
        print_line(line | {"samples_per_second": round(batches.samples * line["per_second"], 2)})


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, default=SAMPLE)
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--workers", type=int, default=0, help="worker processes, 0 for none beside this one")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=4, help="over which memory is watched")
    return parser.parse_args()


def configuration(options: argparse.Namespace) -> TrainingConfig:
    return TrainingConfig(
        dataset="recording",
        depth=DepthModelSpec(height=options.height, width=options.width, min_depth=0.5, max_depth=80),
        recordings=RecordingsConfig(held_out=0, cache_mb=0, workers=options.workers),
        optimizer=OptimizerConfig(samples_per_step=1),
    )


def cases(
    options: argparse.Namespace, index: RecordingIndex, batches: RecordingBatches
) -> dict[str, Callable[[], object]]:
    """Return what goes over one epoch's samples."""
    pictures = jpegs(index)
    rows = [(sample.target, sample.before, sample.after) for sample in batches.reader.samples]
    found: dict[str, Callable[[], object]] = {}
    reductions: dict[str, Reduction] = {"decodes": 1, "reduced decodes": reduction(batches.reader)}
    for name, reduce in reductions.items():
        decodes = DataLoader(
            Decodes(pictures, rows, reduce),
            num_workers=options.workers,
            multiprocessing_context="spawn" if options.workers else None,
            persistent_workers=options.workers > 0,
            worker_init_fn=one_thread,
        )
        found[name] = lambda decodes=decodes: sum(1 for _ in decodes)  # type: ignore[misc]
    found["loader"] = lambda: sum(1 for _ in batches.epoch(0))
    return found


def reduction(reader: SampleReader) -> Reduction:
    """Return by how much the loader's decoder reduces the pictures of the first camera."""
    return next(iter(reader.rigs[0].preprocessor.rectifiers.values())).reduction


class Decodes(Dataset[int]):
    """Decodes the pictures of a sample and gives nothing of them."""

    def __init__(self, pictures: list[list[bytes]], rows: Sequence[Sequence[int]], reduce: Reduction) -> None:
        self._pictures, self._rows, self._reduce = pictures, rows, reduce

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, item: int) -> int:
        for row in self._rows[item]:
            for content in self._pictures[row]:
                decode_compressed("jpeg", content, "camera", reduce=self._reduce)
        return item


def jpegs(index: RecordingIndex) -> list[list[bytes]]:
    """Return the compressed pictures of every set."""
    topics = [camera.image_topic for camera in index.layout.cameras]
    with open_recording(index.path) as recording:
        found = {
            (message.topic, message.log_time): bytes(recording.deserialize(message).data)
            for message in recording.messages(topics)
        }
    return [
        [found[topic, time] for topic, time in zip(topics, times, strict=True)] for times in index.log_times.tolist()
    ]


def one_thread(_: int) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def memory_of_epochs(batches: RecordingBatches, epochs: int) -> list[float]:
    """Return the resident MiB of this process and its workers after each of so many epochs."""
    sizes = []
    for epoch in range(epochs):
        for _ in batches.epoch(epoch):
            pass
        sizes.append(round(resident_mb(), 1))
    return sizes


def resident_mb() -> float:
    own = Path("/proc/self")
    children = (own / "task" / own.resolve().name / "children").read_text().split()
    statuses = [(Path("/proc") / process / "status").read_text() for process in ("self", *children)]
    return sum(int(line.split()[1]) for status in statuses for line in status.splitlines() if "VmRSS" in line) / 1024


if __name__ == "__main__":
    main()
