# SPDX-License-Identifier: Apache-2.0
"""What Linux tells of the processor."""

import pytest

from cvcdepth_core import processor


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("processor\t: 0\nflags\t\t: fpu avx2 avx512_bf16\n\nprocessor\t: 1\nflags\t\t: fpu\n", True),
        ("flags\t\t: fpu amx_bf16 amx_tile\n", True),
        ("flags\t\t: fpu avx2 avx512f\n", False),
        ("Features\t: fp asimd bf16\n", False),
        ("", False),
        (None, False),
    ],
)
def test_bfloat16_is_multiplied_where_the_first_processors_flags_say_so(tmp_path, monkeypatch, text, expected):
    info = tmp_path / "cpuinfo"
    if text is not None:
        info.write_text(text)
    monkeypatch.setattr(processor, "_CPU_INFO", info)
    processor.instructions.cache_clear()
    try:
        assert processor.multiplies_bfloat16() is expected
    finally:
        processor.instructions.cache_clear()
