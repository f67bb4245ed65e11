# SPDX-License-Identifier: Apache-2.0
"""Numbers and lists that pages, help texts and comments repeat are those of the code."""

import re

import pytest
import yaml
from repository import ROOT

from cvcdepth_core.model_choices import ENCODERS
from cvcdepth_core.scoring.scores import ScoreSettings
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.bag_replay import build_parser
from cvcdepth_ros.checks import CHECKS, CheckOptions
from cvcdepth_ros.commands import check
from cvcdepth_ros.evaluation.job import EvaluationSettings
from cvcdepth_ros.settings import MatchingSettings, MissingCameraSettings, ModelSettings, OutputSettings

NUMBERS = dict(
    enumerate(["ten", "eleven", "twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen"], 10)
)
PARAMETERS = ROOT / "config" / "surround_depth.yaml"


class Settings(OutputSettings, MissingCameraSettings, MatchingSettings, ModelSettings):
    """All that the node and the commands have in common."""


def text(name: str) -> str:
    """A page's words, however its lines are broken."""
    return " ".join((ROOT / name).read_text(encoding="utf-8").split())


def choices(field: str) -> tuple[str, ...]:
    """What may be chosen for a setting."""
    return ModelSettings.model_fields[field].annotation.__args__


def test_images_of_one_set_are_as_far_apart_for_training_and_checks_as_for_the_node():
    defaults, checks = MatchingSettings(), CheckOptions()
    assert RecordingsConfig().tolerance == defaults.tolerance
    assert (checks.tolerance, checks.queue_size) == (defaults.tolerance, defaults.queue_size)


def test_the_parameter_file_has_the_defaults_of_the_settings():
    """Its other parameters are the node's own: test_surround_depth_node.py compares them all, where there is ROS."""
    stated = yaml.safe_load(PARAMETERS.read_text())["/**"]["ros__parameters"]
    assert {name: stated[name] for name in Settings.model_fields} == Settings().model_dump()


def test_the_parameter_file_names_every_backend_and_precision():
    (comment,) = re.findall(r"# (What runs the network: .*?)\n    backend:", PARAMETERS.read_text(), re.DOTALL)
    words = set(re.findall(r"[a-z]\w+", comment))
    assert set(choices("backend")) <= words
    assert set(choices("precision")) - {"float32"} <= words


def test_the_help_offers_every_backend_and_precision(capsys: pytest.CaptureFixture[str]):
    for command in ("run", "evaluate", "bench"):
        with pytest.raises(SystemExit):
            build_parser("cvcdepth").parse_args([command, "--help"])
        shown = "".join(capsys.readouterr().out.split())
        for field in ("backend", "precision"):
            assert f"--{field}{{{','.join(choices(field))}}}" in shown
    parser = build_parser("cvcdepth")
    for precision in choices("precision"):
        assert parser.parse_args(["export", "a", "--tensorrt", "--precision", precision]).precision == precision


def test_the_encoders_that_the_settings_name_are_all_there_are():
    described = ModelSettings.model_fields["encoder"].description or ""
    assert set(ENCODERS) == set(re.findall(r"resnet\d+|efficientnet_\w+", described))


def test_the_checks_are_counted_alike_everywhere():
    number = NUMBERS[len(CHECKS)]
    assert f"{number} checks, a remedy for each" in text("README.md")
    assert f"{number.capitalize()} numbered checks: " in check.SUMMARY
    listed = check.SUMMARY.split("numbered checks: ")[1].split(". ")[0]
    assert len(listed.split(",")) == len(CHECKS)


def test_depth_is_scored_between_the_same_limits_in_the_settings_the_scores_and_the_page():
    settings, scores = EvaluationSettings(), ScoreSettings()
    limits = (settings.min_depth, settings.max_depth)
    assert limits == (scores.min_depth, scores.max_depth)
    page = text("docs/evaluation.md")
    assert f"`--min-depth` < depth < `--max-depth` ({limits[0]:g} and {limits[1]:g} m)" in page
    assert f"at most `--lidar-tolerance` ({settings.lidar_tolerance:g} s) away" in page
