# SPDX-License-Identifier: Apache-2.0
"""Whether a packet of H.264 follows the one before, by the frame numbers in its slices (ITU-T H.264, 7.3 and 7.4.3).

Decoders do not tell: FFmpeg's fills a gap with the picture before, and goes on from that as if nothing were missing.
"""

from collections.abc import Iterator

_START_CODE = b"\x00\x00\x01"
_SLICE, _KEY_SLICE, _SEQUENCE = 1, 5, 7
# Profiles whose sequence parameters begin with the format of colours (7.3.2.1.1).
_WITH_COLOURS = frozenset((100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135))
_HEAD = 512  # bytes of a unit that are looked at
_NO_SUBSAMPLING = 3
_MAX_LEADING_ZEROS = 32


class FrameNumbers:
    """Follows the frame numbers of one camera's packets."""

    def __init__(self) -> None:
        self._bits = 0  # of a frame number; 0: no sequence parameters were seen
        self._has_planes = False
        self._last_reference: int | None = None

    def follows(self, packet: bytes) -> bool:
        """Take a packet in; False when one that it is built on is missing. True where that cannot be known."""
        for kind, unit in _units(packet):
            try:
                if kind == _SEQUENCE:
                    self._read_sequence(_Bits(unit))
                elif kind in (_SLICE, _KEY_SLICE):
                    return self._follows(kind == _KEY_SLICE, bool(unit[0] & 0x60), _Bits(unit))
            except (IndexError, ValueError):  # cut short: the decoder will tell
                return True
        return True

    def _follows(self, is_key: bool, is_reference: bool, bits: "_Bits") -> bool:
        if not self._bits:
            return True
        for _ in ("first macroblock", "kind of slice", "picture parameters"):
            bits.exponential()
        if self._has_planes:
            bits.take(2)
        number, last = bits.take(self._bits), self._last_reference
        if is_reference or is_key:
            self._last_reference = number
        return is_key or last is None or number in (last, (last + 1) % (1 << self._bits))

    def _read_sequence(self, bits: "_Bits") -> None:
        profile = bits.take(8)
        bits.take(16)  # constraints, level
        bits.exponential()  # its number
        self._has_planes = False
        if profile in _WITH_COLOURS:
            self._has_planes = _skip_colours(bits)
        self._bits = bits.exponential() + 4


def _skip_colours(bits: "_Bits") -> bool:
    """Read past the format of colours; return whether each colour is a picture of its own."""
    sampling = bits.exponential()
    has_planes = sampling == _NO_SUBSAMPLING and bool(bits.take(1))
    bits.exponential()  # bits of luma
    bits.exponential()  # bits of chroma
    bits.take(1)
    if bits.take(1):
        for number in range(12 if sampling == _NO_SUBSAMPLING else 8):
            if bits.take(1):
                _skip_scaling_list(bits, 16 if number < 6 else 64)
    return has_planes


def _skip_scaling_list(bits: "_Bits", size: int) -> None:
    last, following = 8, 8
    for _ in range(size):
        if following:
            code = bits.exponential()
            following = (last + (code + 1) // 2 * (1 if code % 2 else -1)) % 256
        last = following or last


def _units(packet: bytes) -> Iterator[tuple[int, bytes]]:
    """Give kind and first bytes of each unit, without the bytes that keep start codes out of it (7.4.1)."""
    start = packet.find(_START_CODE)
    while 0 <= start < len(packet) - len(_START_CODE):
        begin = start + len(_START_CODE)
        unit = packet[begin : begin + _HEAD].partition(_START_CODE)[0]
        if unit:
            yield unit[0] & 0x1F, unit.replace(b"\x00\x00\x03", b"\x00\x00")
        start = packet.find(_START_CODE, begin)


class _Bits:
    """Reads a unit bit by bit, after its first byte. IndexError at its end."""

    def __init__(self, unit: bytes) -> None:
        self._bytes = unit
        self._position = 8

    def take(self, count: int) -> int:
        """Return the next bits as a number."""
        value = 0
        for _ in range(count):
            byte, bit = divmod(self._position, 8)
            value = value << 1 | self._bytes[byte] >> 7 - bit & 1
            self._position += 1
        return value

    def exponential(self) -> int:
        """Return the next number in Exp-Golomb code (9.1); ValueError for one that is beyond measure."""
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > _MAX_LEADING_ZEROS:
                raise ValueError("Exp-Golomb code of more than 32 bits")
        return (1 << zeros) - 1 + self.take(zeros)
