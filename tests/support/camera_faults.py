# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a camera's images or its camera_info, by name."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np


@dataclass(frozen=True)
class Fault:
    """What happens to a camera, and what its status must say."""

    says: str
    image: Callable[[Any], Any] | None = None
    info: Callable[[Any], None] | None = None


def sending(make: Callable[[bytes], bytes]) -> Callable[[Any], Any]:
    """Replace the content; what always is the same would make the camera frozen."""
    count = itertools.count()

    def change(image: Any) -> Any:
        image.data = make(bytes(image.data)) + next(count).to_bytes(2, "little")
        return image

    return change


def _declaring(jpeg: bytes) -> bytes:
    frame = jpeg.index(b"\xff\xc0")
    return jpeg[: frame + 5] + b"\xfd\xe8\xfd\xe8" + jpeg[frame + 9 :]


def _png(size: bytes, chunk_length: bytes | None = None) -> bytes:
    png: bytes = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    pixels = png.index(b"IDAT") - 4
    tail = png[pixels:] if chunk_length is None else chunk_length + png[pixels + 4 :]
    return png[:16] + size + png[24:pixels] + tail


def _half_size(jpeg: bytes) -> bytes:
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_REDUCED_COLOR_2)
    content: bytes = cv2.imencode(".jpg", picture)[1].tobytes()
    return content


def _many_scans(jpeg: bytes) -> bytes:
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    progressive = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scan = progressive.rindex(b"\xff\xda")
    return bytes(progressive[:-2] + progressive[scan:-2] * 100 + progressive[-2:])


def silent(image: Any) -> None:
    """No image."""
    return None


def frozen() -> Callable[[Any], Any]:
    """The first picture again and again, with new stamps."""
    kept: list[Any] = []

    def change(image: Any) -> Any:
        kept.append(image.data)
        image.data = kept[0]
        return image

    return change


def _stamp(seconds: int) -> Callable[[Any], Any]:
    def change(image: Any) -> Any:
        image.header.stamp.sec = max(0, image.header.stamp.sec + seconds)
        return image

    return change


def _zero_stamp(image: Any) -> Any:
    image.header.stamp.sec = image.header.stamp.nanosec = 0
    return image


def _k(**numbers: float) -> Callable[[Any], None]:
    def change(info: Any) -> None:
        for index, number in numbers.items():
            info.k[int(index[1:])] = number

    return change


def _set(**fields: Any) -> Callable[[Any], None]:
    def change(info: Any) -> None:
        for name, value in fields.items():
            setattr(info, name, value)

    return change


def _binned(info: Any) -> None:
    info.binning_x = 100_000


def _region(info: Any) -> None:
    info.roi.x_offset, info.roi.width, info.roi.height = 900, 900, 10


FAULTS = {
    "dies": Fault("stale", silent),
    "sends the same picture for ever": Fault("frozen", frozen()),
    "stamps everything zero": Fault("frozen", _zero_stamp),
    "stamps an hour ahead": Fault("unmatched", _stamp(3600)),
    "stamps a quarter of an hour back": Fault("unmatched", _stamp(-900)),
    "sends two bytes": Fault("neither JPEG nor PNG", sending(lambda jpeg: b"")),
    "sends HTML": Fault("neither JPEG nor PNG", sending(lambda jpeg: b"<html><script>alert(1)</script></html>")),
    "sends WebP": Fault("neither JPEG nor PNG", sending(lambda jpeg: b"RIFF\x10\0\0\0WEBPVP8 ")),
    "sends JPEG cut in the middle": Fault("it was cut", sending(lambda jpeg: jpeg[: len(jpeg) // 2])),
    "sends JPEG cut in its header": Fault("its header says no size", sending(lambda jpeg: jpeg[:20])),
    "sends rubbish behind a JPEG's start": Fault("damaged", sending(lambda jpeg: jpeg[:2] + bytes(5000))),
    "sends JPEG that declares 65000 x 65000": Fault("65000x65000", sending(_declaring)),
    "sends PNG that declares 65000 x 65000": Fault("65000x65000", sending(lambda jpeg: _png(b"\0\0\xfd\xe8" * 2))),
    "sends PNG with a chunk of 2 GiB": Fault(
        "it was cut", sending(lambda jpeg: _png(b"\0\0\x03\xc0\0\0\x02\x1c", b"\x7f\xff\xff\xff"))
    ),
    "sends JPEG with hundreds of scans": Fault("scans; at most 64", sending(_many_scans)),
    "sends more than is allowed": Fault("more than max_image_mb", sending(lambda jpeg: jpeg + bytes(1_500_000))),
    "changes its resolution": Fault("but its camera_info says 960x540", sending(_half_size)),
    "calls itself uncalibrated": Fault("K[0] = 0", info=lambda info: setattr(info, "k", np.zeros(9))),
    "sends NaN intrinsics": Fault("is not finite", info=_k(k0=float("nan"))),
    "sends infinite intrinsics": Fault("is not finite", info=_k(k2=float("inf"))),
    "sends a singular K": Fault("zeros left of the diagonal", info=_k(k3=500.0, k6=500.0)),
    "sends a negative focal length": Fault("not a camera matrix", info=_k(k4=-500.0)),
    "sends a focal length of 1e-9": Fault("no lens sees", info=_k(k0=1e-9)),
    "sends an unknown distortion model": Fault("distortion_model", info=_set(distortion_model="fov", d=[0.9])),
    "sends three coefficients": Fault("numbers in d, found 3", info=_set(d=[0.1, 0.2, 0.3])),
    "sends coefficients of 1e300": Fault("no lens has coefficients", info=_set(d=[1e300, 0.0, 0.0, 0.0])),
    "sends ten thousand coefficients": Fault("10000 numbers in d", info=_set(d=[0.0] * 10_000)),
    "sends a size of zero": Fault("the camera has no pixels", info=_set(width=0)),
    "sends a size of 65000 x 65000": Fault("more than 50000000 pixels", info=_set(width=65000, height=65000)),
    "bins all its pixels away": Fault("leaves an image of 0x", info=_binned),
    "sends a region outside of its sensor": Fault("region of interest", info=_region),
    "sends a shear as rotation": Fault("is not a rotation", info=_set(r=np.array([1, 0.5, 0, 0, 1, 0, 0, 0, 1.0]))),
}
