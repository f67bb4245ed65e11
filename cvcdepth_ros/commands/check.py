# SPDX-License-Identifier: Apache-2.0
"""`check`: say whether recordings and a rig will work."""

import argparse
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

from cvcdepth_core.errors import CvcDepthError, RecordingError
from cvcdepth_ros.commands.arguments import (
    add_json,
    add_lidar,
    add_quiet,
    add_recordings,
    add_rig,
    add_skip,
    add_window,
    lidar_topics,
    recording_progress,
    refuse_unknown_checks,
    rig_layout,
    training_file,
    window_ns,
)
from cvcdepth_ros.console import Style, positive, print_result, styled, terminal_width
from cvcdepth_ros.settings import MatchingSettings

if TYPE_CHECKING:
    from cvcdepth_core.rig.rig_file import RigLayout
    from cvcdepth_ros.bags import Location
    from cvcdepth_ros.checks import NumberedResult, Status

SUMMARY = """Check whether recordings and a rig will work, with a remedy for what will not.

Eighteen numbered checks: cameras, calibrations, transforms, stamps, sets, overlaps, masks, LiDAR, motion, encodings,
brightness, whether two cameras were swapped, what `finetune` would learn from, a checkpoint's pose network, how much of
its lens each camera shows, how high the ground lies, and with --pictures whether neighbours' pictures fit the mounts,
and odometry the pictures. The exit code is 1 when a check failed; warnings leave it at 0."""
EXAMPLES: tuple[str, ...] = (
    "check drive.mcap",
    "check drives/ --rig rig.yaml --tolerance 0.05 --lidar /lidar/points --json",
)

_GREATEST_WIDTH = 118
_INDENT = 25


class Checked(NamedTuple):
    """One recording's checks."""

    recording: str
    results: "list[NumberedResult]"
    damage: str | None
    unreadable: str | None
    """Why there are no results."""
    notes: Sequence[str] = ()
    """What is odd about the recording, and how it was understood."""

    @property
    def failed(self) -> list[str]:
        """The names of the checks that failed."""
        return [name for _, name, result in self.results if result.status == "failed"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    tolerance = MatchingSettings().tolerance
    add_recordings(parser)
    add_rig(parser)
    parser.add_argument(
        "--tolerance",
        type=positive,
        default=tolerance,
        metavar="S",
        help=f"seconds that two images of one set may be apart [{tolerance:g}]",
    )
    parser.add_argument(
        "--config",
        default="finetune",
        metavar="FILE",
        help="training configuration by which samples and held-out sets are counted: YAML, or a shipped one [finetune]",
    )
    parser.add_argument(
        "--checkpoint", metavar="FILE", help="compare this checkpoint's pose network with the recorded motion"
    )
    parser.add_argument(
        "--pictures", action="store_true", help="run the network to check mounts and odometry by the pictures"
    )
    add_lidar(parser)
    add_skip(parser)
    add_window(parser)
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Check each recording; RecordingError at the end when a check failed."""
    from cvcdepth_ros.bags import find_recordings

    refuse_unknown_checks(arguments)
    layout = rig_layout(arguments)
    checked = [_checked(location, layout, arguments) for location in find_recordings(arguments.recordings)]
    result = {"recordings": [_json(one) for one in checked]}
    print_result(result, "\n\n".join(_text(one) for one in checked), arguments.json)
    bad = [f"{one.recording}: {_verdict(one)}" for one in checked if one.unreadable or one.failed]
    if bad:
        raise RecordingError("; ".join(bad))


def _checked(location: "Location", layout: "RigLayout | None", arguments: argparse.Namespace) -> Checked:
    from cvcdepth_core.model_choices import checkpoint_path
    from cvcdepth_core.training.config import load_training_config
    from cvcdepth_ros.bags import open_recording
    from cvcdepth_ros.checks import CheckContext, CheckOptions, run_checks

    training = load_training_config(training_file(arguments.config)).recordings
    checkpoint = None if arguments.checkpoint is None else checkpoint_path(arguments.checkpoint)
    try:
        with open_recording(location) as recording:
            window = window_ns(arguments, recording.start)
            options = CheckOptions(
                tolerance=arguments.tolerance,
                base_frame=arguments.base_frame,
                lidar=lidar_topics(arguments),
                start=window[0],
                stop=window[1],
                training=training,
                checkpoint=checkpoint,
                pictures=arguments.pictures,
            )
            with recording_progress(recording, window, arguments.quiet) as progress:
                context = CheckContext(recording, options, layout, progress)
            results = run_checks(context, arguments.skip)
            notes = [*recording.notes, *(context.assembler.notes if context.assembler else [])]
            return Checked(str(location), results, recording.damage, None, notes)
    except CvcDepthError as error:
        return Checked(str(location), [], None, str(error))


def _json(checked: Checked) -> dict[str, Any]:
    counts = Counter(result.status for _, _, result in checked.results)
    return {
        "recording": checked.recording,
        "checks": [{"number": number, "name": name, **asdict(result)} for number, name, result in checked.results],
        "counts": dict(counts),
        "damage": checked.damage,
        "notes": list(checked.notes),
        "unreadable": checked.unreadable,
    }


def _text(checked: Checked) -> str:
    lines = [checked.recording, *(line for result in checked.results for line in _lines(result))]
    if checked.damage:
        lines += _wrapped("    damage", checked.damage)
    for note in checked.notes:
        lines += _wrapped("    note", note)
    if checked.unreadable:
        return f"{checked.recording}\n{''.join(_wrapped('    unreadable', checked.unreadable))}"
    return "\n".join([*lines, f"    {_verdict(checked)}"])


def _lines(numbered: "NumberedResult") -> Iterator[str]:
    number, name, result = numbered
    sign = _SIGNS[result.status]
    first, *others = _wrapped(f"{number:>4}  {sign}  {name}", result.finding)
    style = _STYLES.get(result.status)
    yield first.replace(sign, styled(sign, style), 1) if style else first
    yield from others
    if result.remedy:
        yield from _wrapped("", f"-> {result.remedy}")


_SIGNS = {"passed": "ok  ", "warning": "warn", "failed": "FAIL", "skipped": "-   "}


_STYLES: dict["Status", Style] = {"passed": "green", "warning": "yellow", "failed": "red"}


def _wrapped(label: str, text: str) -> Sequence[str]:
    """Lay out a text beside its label."""
    layout = textwrap.TextWrapper(
        min(_GREATEST_WIDTH, terminal_width()),
        initial_indent=f"{label:<{_INDENT}}",
        subsequent_indent=" " * _INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return layout.wrap(text)


def _verdict(checked: Checked) -> str:
    if checked.unreadable:
        return checked.unreadable
    counts = Counter(result.status for _, _, result in checked.results)
    counted = [f"{counts[status]} {word}" for status, word in _WORDS.items() if counts[status]]
    failed = f" ({', '.join(checked.failed)})" if checked.failed else ""
    return f"{', '.join(counted)}{failed}"


_WORDS: dict["Status", str] = {
    "passed": "passed",
    "warning": "with a warning",
    "skipped": "not applicable",
    "failed": "failed",
}
