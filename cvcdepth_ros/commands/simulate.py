# SPDX-License-Identifier: Apache-2.0
"""`simulate`: record a drive through a rendered world, with exact depth for every pixel."""

import argparse
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_ros.commands.arguments import add_json, add_quiet
from cvcdepth_ros.console import non_negative, positive, print_result, table

if TYPE_CHECKING:
    from cvcdepth_core.worlds.drive import DriveSpec
    from cvcdepth_core.worlds.sensors import Sensors

SUMMARY = """Record a drive through a rendered world, with exact depth for every pixel.

OUT becomes a rosbag2 folder (mcap) with every camera's pictures and camera_info, LiDAR sweeps, /tf and odometry, and
the truth: /camera/NAME/truth/depth (32FC1, metres along the optical axis of the raw picture's pixels, inf for the sky).
Beside it lie the rig file, the world file, which can be edited and simulated again, and simulation.json with all
choices. The same choices give the same bytes, with any number of workers; an interrupted run goes on where it was.
With --many N, OUT becomes a folder of N short drives, one file each for training, every one with a rig and world of its
own (--rig random, --world random or a kind of place). Needs embreex: pip install 'cvcdepth_ros[worlds]'."""
EXAMPLES: tuple[str, ...] = (
    "simulate -o drive",
    "simulate --rig nuscenes --world city --seed 7 --seconds 10 --size 640x384 -o drive",
    "simulate --rig rig.yaml --world drive/world.yaml --odometry wheels --workers 2 -o again",
    "simulate --rig random --world random --many 100 --seconds 1 --size 320x192 -o shards",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder to create")
    parser.add_argument(
        "--rig", default="nuscenes", metavar="RIG",
        help="rig file with calibrations and mounts; ddad, nuscenes or pandaset: one like theirs; or random [nuscenes]",
    )  # fmt: skip
    parser.add_argument(
        "--world", default="random", metavar="WORLD",
        help="world file; or a whole number: the world of that seed; or a kind of place, as city or forest [random]",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of random rigs and worlds, and of all noise [0]"
    )
    parser.add_argument("--seconds", type=positive, default=5.0, metavar="S", help="length of the drive [5]")
    parser.add_argument("--rate", type=positive, metavar="HZ", help="pictures per second of each camera [10]")
    parser.add_argument(
        "--size", type=_size, metavar="WxH", help="pixels of every picture [480 wide, in the rig's shape]"
    )
    parser.add_argument(
        "--images", choices=("jpeg", "png", "raw"), default="jpeg", help="how pictures are stored [jpeg]"
    )
    parser.add_argument("--quality", type=_quality, default=92, metavar="N", help="of JPEG, 1 to 100 [92]")
    parser.add_argument(
        "--truth",
        choices=("none", "depth", "all"),
        default="depth",
        help="depth; or all: objects, what moves, normals and flow too [depth]",
    )
    parser.add_argument(
        "--look", choices=("clean", "varied"), default="varied", help="ideal cameras or real ones [varied]"
    )
    parser.add_argument("--odometry", choices=("exact", "wheels"), default="exact", help="true, or with errors [exact]")
    parser.add_argument(
        "--body", choices=("none", "car", "van", "robot", "varied"), help="own body in view [none; of many: varied]"
    )
    parser.add_argument(
        "--stagger", type=_share, metavar="X", help="share of a period in which cameras fire in turn [0.6]"
    )
    parser.add_argument("--readout", type=non_negative, metavar="S", help="seconds of a rolling shutter [0]")
    parser.add_argument("--no-lidar", action="store_true", help="without LiDAR")
    parser.add_argument("--sensors", type=Path, metavar="FILE", help="file of sensors, for everything else; see docs")
    parser.add_argument(
        "--samples", type=int, choices=(1, 2, 3, 4), default=2, help="rays per pixel along each axis [2]"
    )
    parser.add_argument("--many", type=_whole, metavar="N", help="shards for training instead of a recording")
    parser.add_argument("--workers", type=_whole, default=0, metavar="N", help="processes [one for each processor]")
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Simulate, or go on with what was interrupted."""
    from cvcdepth_core.worlds.rendering.ray_engine import require_engine
    from cvcdepth_ros.simulation.recording import record
    from cvcdepth_ros.simulation.set_messages import Form

    require_engine()
    workers = arguments.workers or len(os.sched_getaffinity(0))
    if arguments.many:
        _simulate_many(arguments, workers)
        return
    spec = _spec(arguments)
    form = Form(arguments.images, arguments.quality, arguments.truth)
    with _progress(spec.sets, "sets", arguments.quiet) as progress:
        result = record(spec, form, arguments.output, workers, progress)
    print_result({"output": str(arguments.output), **result}, _text(arguments.output, result), arguments.json)


def _simulate_many(arguments: argparse.Namespace, workers: int) -> None:
    from cvcdepth_ros.simulation.many import ManyDrives, simulate_many

    for option in ("sensors", "no_lidar"):
        if getattr(arguments, option):
            arguments.usage_error(f"argument --{option.replace('_', '-')}: not with --many")
    if arguments.odometry != "exact":
        arguments.usage_error("argument --odometry: shards hold the true motion")
    if arguments.images == "raw":
        arguments.usage_error("argument --images: shards hold jpeg or png")
    choices = ManyDrives(
        arguments.many,
        arguments.rig,
        arguments.world,
        arguments.size,
        arguments.seed,
        arguments.seconds,
        arguments.rate or 10.0,
        arguments.samples,
        arguments.look,
        arguments.body or "varied",
        arguments.stagger,
        arguments.readout or 0.0,
        arguments.images,
        arguments.quality,
    )
    with _progress(arguments.many, "drives", arguments.quiet) as progress:
        recipe = simulate_many(choices, arguments.output, workers, progress)
    result = {"output": str(arguments.output), **recipe}
    print_result(result, f"{arguments.many} drives in {arguments.output}", arguments.json)


def _spec(arguments: argparse.Namespace) -> "DriveSpec":
    from cvcdepth_core.worlds.drive import DriveSpec
    from cvcdepth_ros.simulation.choices import chosen_layout, chosen_world
    from cvcdepth_ros.simulation.set_messages import recorded_layout

    layout = recorded_layout(chosen_layout(arguments.rig, arguments.size, arguments.seed), arguments.images)
    return DriveSpec(
        layout=layout,
        world=chosen_world(arguments.world, arguments.seed, arguments.seconds),
        sensors=_sensors(arguments, len(layout.cameras)),
        seconds=arguments.seconds,
        samples=arguments.samples,
    )


def _sensors(arguments: argparse.Namespace, cameras: int) -> "Sensors":
    """Return the sensors file's sensors, or those of the options; options that were given come first."""
    from cvcdepth_core.worlds.sensors import Sensors
    from cvcdepth_ros.simulation.choices import chosen_sensors, load_sensors

    if arguments.sensors:
        sensors = load_sensors(arguments.sensors)
    else:
        sensors = chosen_sensors(cameras, arguments.look, arguments.odometry, arguments.seed)
    given = {name: getattr(arguments, name) for name in ("rate", "stagger", "readout")}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if arguments.body == "varied":
        arguments.usage_error("argument --body: varied is for --many")
    changes |= {"body": arguments.body} if arguments.body else {}
    changes |= {"lidar": None} if arguments.no_lidar else {}
    return Sensors.model_validate(sensors.model_dump() | changes)


@contextmanager
def _progress(total: int, unit: str, quiet: bool) -> Iterator[Callable[[int], None]]:
    """Show on a terminal how many are done."""
    from tqdm import tqdm

    with tqdm(total=total, unit=f" {unit}", disable=True if quiet else None, leave=False) as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        yield show


def _text(output: Path, result: dict[str, Any]) -> str:
    world = result["world"]
    rows = [(topic, str(count)) for topic, count in result["messages"].items()]
    return "\n".join(
        [
            table(("topic", "messages"), rows, numbers={1}),
            f"{result['sets']} sets of {world['name']}, {result['triangles']} triangles; {output}",
        ]
    )


def _size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 16 <= int(width) <= 8192 and 16 <= int(height) <= 8192):
        raise argparse.ArgumentTypeError(f"'{text}' is no size like 640x384, of 16 to 8192 pixels")
    return int(width), int(height)


def _whole(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above 0")
    return int(text)


def _quality(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 100:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 1 to 100")
    return int(text)


def _share(text: str) -> float:
    share = non_negative(text)
    if share >= 1.0:
        raise argparse.ArgumentTypeError(f"'{text}' is not at least 0 and below 1")
    return share
