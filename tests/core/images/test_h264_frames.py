# SPDX-License-Identifier: Apache-2.0
"""Frame numbers in packets of H.264, with parameters that the encoder of the other tests does not use."""

import random

import pytest

from cvcdepth_core.images.h264_frames import FrameNumbers


def exponential(value: int) -> str:
    code = f"{value + 1:b}"
    return "0" * (len(code) - 1) + code


def unit(head: int, bits: str) -> bytes:
    bits += "1"
    bits += "0" * (-len(bits) % 8)
    content = bytes([head]) + int(bits, 2).to_bytes(len(bits) // 8, "big")
    return b"\0\0\1" + content.replace(b"\0\0\1", b"\0\0\3\1").replace(b"\0\0\0", b"\0\0\3\0")


def parameters(number_bits: int, profile: int = 66, colours: str = "") -> bytes:
    return unit(0x67, f"{profile:08b}{0:08b}{30:08b}{exponential(0)}{colours}{exponential(number_bits - 4)}")


def picture(number: int, number_bits: int, head: int = 0x41, planes: str = "") -> bytes:
    kinds = exponential(0) + exponential(5) + exponential(0)
    return unit(head, f"{kinds}{planes}{number:0{number_bits}b}")


# A matrix of scaling lists is there; the first has 16 numbers, each of the other seven is absent.
SCALED = "1" + "1" + exponential(1) + "1" * 15 + "0" * 7


@pytest.mark.parametrize(
    ("profile", "colours", "planes"),
    [
        (66, "", ""),
        (100, exponential(1) + exponential(0) * 2 + "0" + "0", ""),
        (244, exponential(3) + "1" + exponential(0) * 2 + "0" + "0", "01"),
        (100, exponential(1) + exponential(0) * 2 + "0" + SCALED, ""),
    ],
)
def test_a_gap_is_noticed_and_numbers_that_start_again_are_none(profile: int, colours: str, planes: str):
    bits = 5
    numbers = FrameNumbers()
    key = parameters(bits, profile, colours) + picture(0, bits, 0x65, planes)
    assert numbers.follows(key)
    for number in range(1, 40):  # they start again at 32
        assert numbers.follows(picture(number % 32, bits, planes=planes))
    assert numbers.follows(picture(8, bits, 0x01, planes))  # nothing is built on it
    assert numbers.follows(picture(8, bits, planes=planes))
    assert not numbers.follows(picture(10, bits, planes=planes))
    assert numbers.follows(key)


def test_what_nothing_is_known_of_is_no_gap():
    assert FrameNumbers().follows(picture(9, 4))
    assert FrameNumbers().follows(b"")


def test_no_bytes_raise():
    dice, numbers = random.Random(0), FrameNumbers()
    for _ in range(3000):
        kinds = (dice.choice((0x67, 0x65, 0x41, 0x01)) for _ in range(3))
        numbers.follows(b"".join(b"\0\0\1" + bytes([kind]) + dice.randbytes(dice.randrange(30)) for kind in kinds))
