# SPDX-License-Identifier: Apache-2.0
"""How long six JPEGs take to become the network's pictures, in one thread.

    .venv/bin/python benchmarks/preprocess.py [--height 192 --width 320] [--rounds 30]

The baseline decodes and undistorts at full size and resizes then. The others are the parts of what all programs here
do, and that whole.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from measuring import json_lines, measure_in_turns, print_line

from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.images.surround import SurroundPreprocessor, to_tensor
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.recordings.rig import discover_rig
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.set_estimation import EncodedImage, picture_or_error

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--rounds", type=int, default=30)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    with open_recording(SAMPLE) as recording:
        layout = discover_rig(recording)
        topics = [camera.image_topic for camera in layout.cameras]
        messages = [recording.deserialize(next(iter(recording.messages([topic])))) for topic in topics]
        rig = layout.complete()
    width, height = rig.cameras[0].calibration.image_size
    sizes = {"cameras": len(messages), "image": f"{height}x{width}", "picture": f"{options.height}x{options.width}"}
    timings = measure_in_turns(cases(messages, rig, options.height, options.width), options.rounds)
    for line in json_lines("preprocessing", timings, "straightforward", sizes):
        print_line(line)


def cases(messages: Sequence[Any], rig: Rig, height: int, width: int) -> dict[str, Callable[[], object]]:
    rectifiers = list(SurroundPreprocessor(rig, height, width).rectifiers.values())
    pictures = [picture_from_message(message, "camera") for message in messages]
    small = pictures_of(messages, rectifiers)
    undistorted = [full_size_maps(camera) for camera in rig.cameras]
    return {
        "straightforward": lambda: to_tensor(
            [
                resized(picture_from_message(m, ""), *maps, height, width)
                for m, maps in zip(messages, undistorted, strict=True)
            ]
        ),
        "decode at full size": lambda: [picture_from_message(message, "camera") for message in messages],
        "rectify": lambda: [rectify(picture, "camera") for rectify, picture in zip(rectifiers, pictures, strict=True)],
        "to tensor": lambda: to_tensor(small),
        "all together": lambda: to_tensor(pictures_of(messages, rectifiers)),
    }


def pictures_of(messages: Sequence[Any], rectifiers: Sequence[Rectifier]) -> list[Picture]:
    """Do what node, bag tool and trainer do."""
    outcomes = [
        picture_or_error(EncodedImage(m), "camera", r, StageLatencies())
        for m, r in zip(messages, rectifiers, strict=True)
    ]
    return [outcome for outcome in outcomes if not isinstance(outcome, Exception)]


def full_size_maps(camera: Camera) -> tuple[Any, Any]:
    calibration = camera.calibration
    raw, rectified = calibration.raw_intrinsics, calibration.rectified_intrinsics
    return cv2.initUndistortRectifyMap(
        raw, calibration.distortion, calibration.rotation, rectified, calibration.image_size, cv2.CV_32FC1
    )


def resized(picture: Picture, x: Any, y: Any, height: int, width: int) -> Picture:
    undistorted = cv2.remap(picture, x, y, cv2.INTER_LINEAR)
    return np.asarray(cv2.resize(undistorted, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


if __name__ == "__main__":
    main()
