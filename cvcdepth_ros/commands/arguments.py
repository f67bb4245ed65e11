# SPDX-License-Identifier: Apache-2.0
"""Options that several commands have in common, and what their values mean."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin

from pydantic import ValidationError

from cvcdepth_core.errors import ConfigError, first_validation_message
from cvcdepth_ros.console import non_negative, positive, progress_bar
from cvcdepth_ros.installation import share_directory
from cvcdepth_ros.settings import ModelSettings

if TYPE_CHECKING:
    from cvcdepth_core.rig.rig_file import RigLayout
    from cvcdepth_ros.bags import Recording

SettingsT = TypeVar("SettingsT", bound=ModelSettings)


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Declare the recording."""
    parser.add_argument("recording", metavar="BAG", help="rosbag2 folder, or a single .mcap, .db3 or ROS 1 .bag file")


def add_recordings(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Declare one or many recordings, for `find_recordings`."""
    parser.add_argument(
        "recordings",
        nargs="+" if required else "*",
        metavar="BAG",
        help="rosbag2 folder, or .mcap, .db3 or ROS 1 .bag file; folder of these, glob, or URL (s3://bucket/drive.mcap)",
    )


def add_rig(parser: argparse.ArgumentParser, default: str = "the cameras found in each recording") -> None:
    """Declare the rig file, and the vehicle's frame where there is none; for `rig_layout`."""
    parser.add_argument("--rig", type=Path, metavar="FILE", help=f"rig file [{default}]")
    parser.add_argument(
        "--base-frame", metavar="FRAME", default="base_link", help="without --rig: the vehicle's frame [base_link]"
    )


def rig_layout(arguments: argparse.Namespace) -> "RigLayout | None":
    """Return the rig file's content; None where none is named. RigError says what is wrong with it."""
    from cvcdepth_core.rig.rig_file import load_rig_layout

    return load_rig_layout(arguments.rig) if arguments.rig else None


def add_training_run(parser: argparse.ArgumentParser, shipped: str, start: str) -> None:
    """Declare the run's folder, its configuration (`shipped` names one), and what it starts from (`start`: help)."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="the run's folder")
    parser.add_argument(
        "--config",
        required=True,
        metavar="FILE",
        help=f"training configuration (YAML), or a shipped one by name: {shipped}",
    )
    starts = parser.add_mutually_exclusive_group(required=True)
    starts.add_argument("--from", dest="start", metavar="CHECKPOINT", help=start)
    starts.add_argument("--from-scratch", action="store_true", help="start from random weights")


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Declare `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def refuse_to_overwrite(*files: Path) -> None:
    """Raise ConfigError, naming the file, for the first that is there; for commands that take `--force`."""
    for path in files:
        if path.exists():
            raise ConfigError(f"{path}: exists already; --force overwrites it")


def add_lidar(parser: argparse.ArgumentParser) -> None:
    """Declare which topics are the LiDARs', for `lidar_topics`."""
    lidar = parser.add_mutually_exclusive_group()
    lidar.add_argument(
        "--lidar",
        action="append",
        metavar="TOPIC",
        help="a LiDAR; can be repeated [all point clouds of a recording without colours: those with come from cameras]",
    )
    lidar.add_argument("--no-lidar", action="store_true", help="as if there were none: label-free scores only")


def lidar_topics(arguments: argparse.Namespace) -> tuple[str, ...] | None:
    """Return the LiDARs that are wanted; None: those of each recording."""
    return () if arguments.no_lidar else tuple(arguments.lidar) if arguments.lidar else None


def add_window(parser: argparse.ArgumentParser) -> None:
    """Declare the part of the recording that is wanted."""
    parser.add_argument(
        "--start", type=non_negative, default=0.0, metavar="S", help="seconds of the recording to skip [0]"
    )
    parser.add_argument("--duration", type=positive, metavar="S", help="seconds of the recording to take [to its end]")


def add_skip(parser: argparse.ArgumentParser) -> None:
    """Declare checks that are to be left out, for `refuse_unknown_checks`."""
    parser.add_argument(
        "--skip", action="append", default=[], metavar="CHECK", help="leave a check out, by its name; can be repeated"
    )


def refuse_unknown_checks(arguments: argparse.Namespace) -> None:
    """End the program as wrong use when `--skip` names no check."""
    from cvcdepth_ros.checks import CHECKS

    unknown = [name for name in arguments.skip if name not in CHECKS]
    if unknown:
        arguments.usage_error(f"argument --skip: no check is called {unknown[0]!r}; there are {', '.join(CHECKS)}")


def add_json(parser: argparse.ArgumentParser) -> None:
    """Declare `--json`."""
    parser.add_argument("--json", action="store_true", help="print the result as one JSON document")


def add_settings(
    parser: argparse.ArgumentParser, settings: type[ModelSettings], repeatable: Sequence[str] = ()
) -> "argparse._MutuallyExclusiveGroup":
    """Declare an option for every field of a settings model; what is not given keeps the model's default.

    Options of `repeatable` fields give lists. Returns the group of those options of which at most one is given.
    """
    network = parser.add_mutually_exclusive_group()
    for name, field in settings.model_fields.items():
        group = network if name in ("checkpoint", "untrained", "predictor") else parser
        shown = "" if field.default in ("", None) or field.default is False else f" [{field.default}]"
        reading = _value_of(field.annotation) | ({"action": "append"} if name in repeatable else {})
        option = f"--{name.replace('_', '-')}"
        group.add_argument(option, help=f"{field.description}{shown}", default=argparse.SUPPRESS, **reading)
    return network


def settings_from(arguments: argparse.Namespace, settings: type[SettingsT]) -> SettingsT:
    """Build the settings that `add_settings` declared; a value out of range ends the program as wrong use."""
    given = {name: value for name, value in vars(arguments).items() if name in settings.model_fields}
    untrained_only = sorted(given.keys() & {"encoder", "height", "width"})
    if untrained_only and not given.keys() & {"untrained", "predictor"}:
        arguments.usage_error(f"--{', --'.join(untrained_only)}: for --untrained only, a checkpoint names its own")
    try:
        return settings.model_validate(given)
    except ValidationError as error:
        field, _, reason = first_validation_message(error).partition(":")
        arguments.usage_error(f"argument --{field.replace('_', '-')}:{reason}")
        raise


def training_file(name: str) -> Path:
    """Return the training file that is meant: a file, or a shipped one by its stem, as in `finetune`.

    ConfigError names the shipped ones, the nearest first, when there is none.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return path
    shipped = {found.stem: found for found in sorted((share_directory() / "config" / "training").rglob("*.yaml"))}
    if name in shipped:
        return shipped[name]
    nearest = get_close_matches(path.stem, shipped, n=1)
    hint = f"did you mean {nearest[0]}? " if nearest else ""
    raise ConfigError(f"{name}: no such file, and no shipped training file; {hint}There are {', '.join(shipped)}")


def window_ns(arguments: argparse.Namespace, recording_start: int) -> tuple[int, int | None]:
    """Return first and last (exclusive; None: the end) log time in nanoseconds, from the options of `add_window`."""
    start = recording_start + round(arguments.start * 1e9)
    return start, None if arguments.duration is None else start + round(arguments.duration * 1e9)


@contextmanager
def recording_progress(
    recording: "Recording", window: tuple[int, int | None], quiet: bool
) -> Iterator[Callable[[int], None]]:
    """Show on a terminal how much of the window is read; give a function to be called with the log times (ns) read."""
    start, stop = window[0], min(window[1] or recording.end, recording.end)
    seconds = (stop - start) / 1e9
    with progress_bar(seconds, "s recorded", quiet=quiet, is_kept=False) as show:
        yield lambda log_time: show((log_time - start) / 1e9)


def _value_of(annotation: Any) -> dict[str, Any]:
    """Return argparse's way of reading a value of this type, or of this type or None."""
    if type(None) in get_args(annotation):
        (annotation,) = (kind for kind in get_args(annotation) if kind is not type(None))
    if annotation is bool:
        return {"action": "store_true"}
    if get_origin(annotation) is Literal:
        return {"choices": get_args(annotation)}
    return {"type": annotation, "metavar": {int: "N", float: "X"}.get(annotation, "TEXT")}
