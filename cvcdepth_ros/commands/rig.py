# SPDX-License-Identifier: Apache-2.0
"""`rig`: describe the cameras of a recording in a rig file."""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from pydantic import ValidationError

from cvcdepth_core.errors import ConfigError, RigError, first_validation_message
from cvcdepth_core.rig.view import Aspect
from cvcdepth_ros.commands.arguments import add_json, add_recording, add_rig, refuse_to_overwrite, rig_layout
from cvcdepth_ros.console import print_result, progress_bar, table, warn
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.process_setup import prepare_long_work

if TYPE_CHECKING:
    from cvcdepth_core.rig.rig import Camera, Rig
    from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
    from cvcdepth_ros.recordings.ground import RecordedGround
    from cvcdepth_ros.recordings.rig import RecordedRig

_NARROWEST_DEG = 5.0

SUMMARY = """Write a rig file from a recording.

Finds the cameras, takes their calibrations from camera_info and their poses from /tf_static, orders them
counter-clockwise around the vehicle from the front one, and computes which of them see the same space. With --masks it
finds where a camera sees the vehicle itself, which stands still in the picture while the scene moves, and writes a PNG
for it beside the rig file. With --rig, a file that names the cameras only (config/rigs/) is completed. With --refine,
cameras are turned a little so that neighbours' pictures agree where they overlap; it refuses where they do not tell.
How high the ground lies in the base frame is measured by LiDAR, or by pictures while the vehicle moves.

With --view the cameras show so much of their lenses, whatever P of camera_info says. A lens of more than 120 degrees is
shown by two or three virtual cameras, NAME_l, NAME_m and NAME_r."""
EXAMPLES: tuple[str, ...] = (
    "rig drive.mcap",
    "rig drive/ -o rigs/shuttle.yaml --base-frame base_footprint --anchor front",
    "rig drive.mcap --view lens",
    "rig drive.mcap --view 98 --view back=170 --aspect pad",
    "rig drive/ --rig rigs/shuttle.yaml --refine -o rigs/shuttle_refined.yaml",
)


_PARTS, _PART_SECONDS = 4, 2.5  # of the recording, that neighbours are compared in


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recording(parser)
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("rig.yaml"), metavar="FILE", help="rig file to write [rig.yaml]"
    )
    add_rig(parser, "the cameras found in the recording")
    parser.add_argument("--anchor", metavar="NAME", help="camera whose stamp a set carries [the front one]")
    parser.add_argument(
        "--view", action="append", default=[], metavar="[NAME=]DEGREES",
        help="horizontal view of all cameras or of one; 'lens': all that it sees; can be repeated [as P says]",
    )  # fmt: skip
    parser.add_argument(
        "--aspect", choices=get_args(Aspect),
        help="how pictures come into a network of another shape: rows cut off, with empty borders, or stretched [crop]",
    )  # fmt: skip
    parser.add_argument(
        "--ground-height",
        type=float,
        metavar="M",
        help="how high the ground lies in the base frame, metres: below 0 where that is above it [as the recording "
        "shows]",
    )
    parser.add_argument("--masks", action="store_true", help="find the vehicle's own body (reads the whole recording)")
    parser.add_argument(
        "--refine", action="store_true", help="turn cameras until neighbours' pictures agree (runs the network)"
    )
    parser.add_argument(
        "--checkpoint", default="", metavar="FILE", help="with --refine: the network's weights [the package's own]"
    )
    parser.add_argument("--force", action="store_true", help="overwrite the rig file and its masks")
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Write the rig file and show what is in it."""
    from cvcdepth_core.rig.rig_file import save_rig_layout
    from cvcdepth_ros.bags import open_recording
    from cvcdepth_ros.recordings.rig import RecordedRig

    if not arguments.force:
        refuse_to_overwrite(arguments.output)
    with open_recording(arguments.recording) as recording:
        given = rig_layout(arguments)
        recorded = RecordedRig.from_recording(recording, given, arguments.base_frame)
        recorded = recorded if given is None else recorded.completed()
        if arguments.view:
            recorded = recorded.with_layout(_with_views(recorded.layout, arguments.view)).completed()
        ground = _ground(recorded, arguments.ground_height)
        layout = _with_ground(recorded.layout, ground)
        layout = layout.model_copy(
            update={
                "anchor": _anchor(layout, arguments.anchor),
                "aspect": arguments.aspect or layout.aspect,
            }
        )
        path, shares = recording.path, dict[str, float]()
        for note in recorded.notes():
            warn(f"{path}: {note}")
        if arguments.masks:
            folder = arguments.output.parent / f"{arguments.output.stem}_masks"
            if not arguments.force:
                refuse_to_overwrite(*(folder / f"{name}.png" for name in layout.names))
            layout, shares = _with_found_masks(recorded.with_layout(layout), folder)
        mounts: dict[str, Any] = {}
        if arguments.refine:
            layout, mounts = _with_refined_mounts(recorded.with_layout(layout), arguments.checkpoint)
    result = {**_describe(layout, layout.complete(), shares), "ground": ground.to_json(), **mounts}
    source = f"cvcdepth rig {package_version()}, from the recording {path.name}"
    save_rig_layout(arguments.output, layout, f"Written by {source}.\n{_overlaps_text(result)}\n{ground.told}.")
    result = {"file": str(arguments.output), "recording": arguments.recording, **result}
    print_result(result, _text(result), arguments.json)


def _with_found_masks(recorded: "RecordedRig", folder: Path) -> tuple["RigLayout", dict[str, float]]:
    """Return the layout with the masks that are found, and the share that each takes of its picture."""
    from cvcdepth_ros.settings import MatchingSettings
    from cvcdepth_ros.training_data.index import index_recording
    from cvcdepth_ros.training_data.own_body_masks import find_self_occlusion, save_masks

    found = find_self_occlusion(index_recording(recorded.completed(), MatchingSettings(), scale_from="nothing"))
    for doubt in found.doubts(folder):
        warn(f"{recorded.recording.path}: {doubt}")
    shares = {name: round(body.share, 4) for name, body in found.by_camera.items()}
    return save_masks(recorded.layout, found, folder), shares


def _with_views(layout: "RigLayout", wanted: Sequence[str]) -> "RigLayout":
    """Return the layout with the views of `--view`; a later one replaces an earlier one's."""
    from cvcdepth_core.rig.wide_lenses import lens_name, with_views, without_views

    topics = {lens_name(names): topic for topic, names in layout.views_by_image.items()}
    chosen: dict[str, str] = {}
    for text in wanted:
        name, separator, degrees = text.rpartition("=")
        if separator and name not in topics:
            raise ConfigError(f"view {text}: no camera is called {name}; there are {', '.join(topics)}")
        chosen.update(dict.fromkeys([name] if separator else topics, degrees))
    layout = without_views(layout, [topics[name] for name in chosen])
    entries = {entry.name: entry for entry in layout.cameras}
    return with_views(layout, {name: _view_degrees(entries[name], text) for name, text in chosen.items()})


def _view_degrees(entry: "CameraEntry", text: str) -> float:
    from cvcdepth_core.rig.lens import field_of_view

    lens = math.inf if entry.calibration is None else field_of_view(entry.calibration, entry.rectified).horizontal
    if text == "lens":
        return lens
    try:
        degrees = float(text)
    except ValueError as error:
        raise ConfigError(f"view {text}: want degrees, or 'lens'") from error
    if not _NARROWEST_DEG <= degrees <= lens + 1:
        raise ConfigError(f"view {text}: camera {entry.name} has a lens of {lens:.1f} degrees")
    return degrees


def _with_refined_mounts(recorded: "RecordedRig", checkpoint: str) -> tuple["RigLayout", dict[str, Any]]:
    """Return the layout with turned cameras, and what tells of it; RigError where the pictures carry no turn."""
    from cvcdepth_ros.recordings.compared_pictures import compare_pictures, mounts_to_json, parts_of, turned_layout
    from cvcdepth_ros.settings import MatchingSettings, ModelSettings

    prepare_long_work()
    recording, settings = recorded.recording, ModelSettings.model_validate({"checkpoint": checkpoint})
    parts = parts_of(recording.start, recording.end + 1, _PARTS, _PART_SECONDS)
    with progress_bar(1.0, "of the search", is_kept=False) as show:
        compared = compare_pictures(recorded, settings.build_estimator(), parts, MatchingSettings(), show)
    told = mounts_to_json(compared.rig, compared.mounts)
    used = [pair for pair in told["pairs"] if pair["problem"] is None]
    if not used:
        first = told["pairs"][0]["problem"] if told["pairs"] else "no two cameras overlap"
        raise RigError(f"{recording.path}: --refine: no pair of neighbours tells how its cameras are turned: {first}")
    for name, turn in told["turns"].items():
        if turn is None:
            warn(
                f"{recording.path}: camera {name}: no pair of neighbours leads to {compared.rig.anchor}; left as it is"
            )
    return turned_layout(recorded.layout, compared.mounts), {"refined": told}


def _ground(recorded: "RecordedRig", height: float | None) -> "RecordedGround":
    """Return the ground that is asked for, else the rig file's, else the one that the recording shows."""
    from cvcdepth_ros.recordings.ground import RecordedGround, recorded_ground

    if height is not None:
        return RecordedGround(height, "stated", recorded.layout.base_frame)
    ground = recorded_ground(recorded)
    if ground.is_assumed:
        warn(f"{recorded.recording.path}: {ground.told}")
    return ground


def _with_ground(layout: "RigLayout", ground: "RecordedGround") -> "RigLayout":
    from cvcdepth_core.rig.rig_file import RigLayout

    if ground.is_assumed:
        return layout
    try:
        return RigLayout.model_validate(layout.model_dump() | {"ground_height": ground.height})
    except ValidationError as error:
        raise ConfigError(f"--ground-height: {first_validation_message(error)}") from error


def _anchor(layout: "RigLayout", wanted: str | None) -> str:
    """Return the camera that is asked for, of a lens with several views the middle one, else the rig's."""
    from cvcdepth_core.rig.wide_lenses import from_left_to_right, lens_name

    lenses = {lens_name(names): from_left_to_right(layout, names) for names in layout.views_by_image.values()}
    if wanted in lenses:
        return lenses[wanted][(len(lenses[wanted]) - 1) // 2]
    if wanted is not None and wanted not in layout.names:
        raise ConfigError(f"anchor: no camera is called {wanted}; there are {', '.join(layout.names)}")
    return wanted or layout.anchor_camera


def _describe(layout: "RigLayout", rig: "Rig", masked: Mapping[str, float]) -> dict[str, Any]:
    from cvcdepth_core.rig.ground import heights_above_ground

    heights = heights_above_ground(rig)
    return {
        "base_frame": rig.base_frame,
        "anchor": rig.anchor,
        "ground_height": rig.ground_height,
        "cameras": [
            {
                "name": camera.name,
                "image_topic": entry.image_topic,
                "frame_id": entry.frame_id,
                "mask": str(entry.mask) if entry.mask else None,
                "masked_share": masked.get(camera.name),
                "metres_above_ground": round(heights[camera.name], 3),
                **_view(entry, camera),
            }
            for entry, camera in zip(layout.cameras, rig.cameras, strict=True)
        ],
        "overlaps": [
            {
                "camera": overlap.camera,
                "neighbour": overlap.neighbour,
                "degrees": round(overlap.angle, 2),
                "are_neighbours": overlap.neighbour in rig.neighbours[overlap.camera],
            }
            for overlap in rig.overlaps
        ],
    }


def _view(entry: "CameraEntry", camera: "Camera") -> dict[str, Any]:
    """Return the camera's direction, field of view, and the kind of its pictures."""
    from cvcdepth_core.rig.lens import field_of_view

    calibration = camera.calibration
    lens = field_of_view(entry.calibration or calibration, entry.rectified).horizontal
    axis = camera.base_T_camera[:3, 2]
    (fx, _, cx), (width, height) = calibration.rectified_intrinsics[0], calibration.image_size
    view = math.atan((width - 0.5 - cx) / fx) + math.atan((cx + 0.5) / fx)
    return {
        "yaw_degrees": round(math.degrees(math.atan2(axis[1], axis[0])), 2),
        "horizontal_view_degrees": round(math.degrees(view), 2),
        "lens_degrees": round(lens, 2),
        "width": width,
        "height": height,
        "distortion": calibration.distortion_model if any(calibration.d) else "none",
        "rectified": camera.rectified,
    }


def _text(result: dict[str, Any]) -> str:
    cameras = [
        (
            camera["name"],
            f"{camera['yaw_degrees']:.1f}",
            _view_text(camera),
            f"{camera['metres_above_ground']:.2f}",
            f"{camera['width']}x{camera['height']}",
            "rectified" if camera["rectified"] else camera["distortion"],
            _mask_text(camera),
            camera["image_topic"],
        )
        for camera in result["cameras"]
    ]
    refined = f"{_refined_text(result['refined'])}\n\n" if "refined" in result else ""
    header = ("camera", "yaw (deg)", "view (deg)", "height (m)", "size", "distortion", "mask", "images")
    return (
        f"{table(header, cameras, apart=len(header) - 1)}\n\n{_overlaps_text(result)}\n\n{refined}"
        f"{result['ground']['told']}\n"
        f"base frame {result['base_frame']}, anchor camera {result['anchor']}; written to {result['file']}"
    )


def _view_text(camera: dict[str, Any]) -> str:
    view, lens = camera["horizontal_view_degrees"], camera["lens_degrees"]
    return f"{view:.1f}" if abs(lens - view) < 1 else f"{view:.1f} of {lens:.1f}"


def _refined_text(refined: dict[str, Any]) -> str:
    """Show how well neighbours' pictures agree, and how each camera was turned."""
    pairs = [
        (_pair_name(pair), str(pair["patches"]), _number(pair["before"]), _number(pair["after"]))
        for pair in refined["pairs"]
    ]
    shown = table(("neighbours' pictures", "patches", "correlation", "turned"), pairs, numbers=range(1, 4))
    left_out = [f"left out: {_pair_name(pair)}: {pair['problem']}" for pair in refined["pairs"] if pair["problem"]]
    turns = [
        f"  {name}: {'left as it is' if turn is None else ' '.join(f'{angle:+.2f}' for angle in turn)}"
        for name, turn in refined["turns"].items()
    ]
    return "\n".join(
        [shown, *left_out, "", "Turned about its own x (right), y (down) and z (ahead), in degrees:", *turns]
    )


def _pair_name(pair: dict[str, Any]) -> str:
    return f"{pair['camera']} - {pair['neighbour']}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _mask_text(camera: dict[str, Any]) -> str:
    share = "" if camera["masked_share"] is None else f" ({camera['masked_share']:.0%})"
    return f"{camera['mask'] or 'none'}{share}"


def _overlaps_text(result: dict[str, Any]) -> str:
    lines = [
        f"  {overlap['camera']} - {overlap['neighbour']}: {overlap['degrees']:.1f}"
        f"{'' if overlap['are_neighbours'] else ' (too narrow: no neighbours)'}"
        for overlap in result["overlaps"]
    ]
    return "\n".join(["Shared view, in degrees of the first camera's width:", *(lines or ["  none"])])
