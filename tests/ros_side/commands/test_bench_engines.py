# SPDX-License-Identifier: Apache-2.0
"""`cvcdepth bench engines`: what each engine takes, and which one `auto` would."""

import json

import pytest

from cvcdepth_core.engines import is_installed, selection
from cvcdepth_core.errors import EngineError
from cvcdepth_ros.bag_replay import main

SMALL = ("--untrained", "--encoder", "resnet18", "--height", "64", "--width", "96", "--device", "cpu")
INSTALLED = [name for name in ("ncnn", "openvino", "torch", "onnxruntime", "torch_eager") if is_installed(name)]


def test_every_engine_that_is_installed_is_measured_and_the_first_is_what_auto_takes(
    capsys: pytest.CaptureFixture[str],
):
    assert main(["bench", "engines", *SMALL, "--threads", "1", "--sets", "2", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [engine["backend"] for engine in result["engines"]] == INSTALLED
    assert result["auto"] == INSTALLED[0]
    assert (result["network"], result["size"], result["threads"]) == ("resnet18", "64x96", 1)
    for engine in result["engines"]:
        assert engine["engine"].startswith(engine["backend"])
        assert engine["cpu_ms"] > 0
        assert engine["ready_s"] > 0


def test_a_broken_engine_is_named_and_auto_is_the_next(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def build(backend: str, *others: object) -> object:
        if backend == INSTALLED[0]:
            raise EngineError("its library is missing")
        return built(backend, *others)

    built = selection._build
    monkeypatch.setattr(selection, "_build", build)
    few = (*INSTALLED[:2], "torch", "torch_eager")  # the others take their time
    monkeypatch.setattr(selection, "is_installed", few.__contains__)
    assert main(["bench", "engines", *SMALL, "--sets", "1"]) == 0
    *_, problem, verdict = capsys.readouterr().out.splitlines()
    assert problem == f"{INSTALLED[0]}: its library is missing"
    assert verdict == f"auto takes {INSTALLED[1]}"


def test_what_no_engine_can_do_is_an_error(capsys: pytest.CaptureFixture[str]):
    assert main(["bench", "engines", *SMALL, "--precision", "float16"]) == 1
    assert "precision float16 needs a CUDA device" in capsys.readouterr().err


@pytest.mark.parametrize("option", [("--threads", "0"), ("--sets", "many")])
def test_counts_are_whole_numbers(option: tuple[str, str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["bench", "engines", *SMALL, *option])
    assert "is not a whole number of at least 1" in capsys.readouterr().err
