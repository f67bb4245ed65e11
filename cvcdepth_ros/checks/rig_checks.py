# SPDX-License-Identifier: Apache-2.0
"""Checks of the cameras: whether they are there, calibrated and connected, and their images can be decoded."""

from __future__ import annotations

from collections.abc import Mapping

from cvcdepth_core.rig.lens_use import lens_uses
from cvcdepth_ros.checks.context import CheckContext, CheckResult
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras
from cvcdepth_ros.messages.transforms import frame_name
from cvcdepth_ros.recordings.fixed_frames import MOVING_TRANSFORMS
from cvcdepth_ros.recordings.rig import topic_problems
from cvcdepth_ros.recordings.rig_messages import STATIC_TRANSFORMS

_MAX_LISTED = 2


def check_cameras(context: CheckContext) -> CheckResult:
    """Look for the rig file's cameras, or for any; half recorded ones count too."""
    recording = context.recording
    if context.has_rig_file and context.assembler is not None:
        layout = context.assembler.layout
        problems = [*topic_problems(recording, layout)]
        remedy = "correct the topics in the rig file; `cvcdepth inspect` lists those recorded"
        return _judged(problems, remedy, f"{len(layout.names)} of the rig file: {', '.join(layout.names)}")
    cameras = find_recorded_cameras(recording)
    names = [camera.name for camera in cameras.cameras]
    found = f"{len(names)} found: {', '.join(names)}" if names else "none found"
    values = {
        "cameras": names,
        "without_images": cameras.without_images,
        "without_camera_info": cameras.without_info,
        "choices": cameras.choices,
        "left_out": cameras.left_out,
    }
    if values["without_images"]:
        remedy = "record its images, or give a rig file without this camera (--rig)"
        return CheckResult("failed", f"{found}; no image beside {', '.join(values['without_images'])}", remedy, values)
    if context.refusal is not None:
        remedy = "record a camera_info beside the images of each camera, in one namespace each"
        remedy += cameras.offers and f"; {cameras.offers}"
        return CheckResult("failed", f"{found}; {context.refusal}" if names else found, remedy, values)
    if values["without_camera_info"]:
        remedy = cameras.offers or "record its camera_info, or give its calibration in a rig file (--rig)"
        finding = f"{found}; no camera_info beside {', '.join(values['without_camera_info'])}"
        return CheckResult("warning", finding, remedy, values)
    told = "; ".join([*cameras.choices, *cameras.left_out][:_MAX_LISTED])
    found = f"{found}; {told}" if told else found
    if len(names) == 1:
        remedy = "it is enough for run, node and evaluate; scale is learned from two cameras that overlap, or odometry"
        return CheckResult("warning", found, remedy, values)
    return CheckResult("passed", found, values=values)


def check_camera_infos(context: CheckContext) -> CheckResult:
    """Validate each camera's calibration, and compare its size with that of the camera's first image."""
    if context.assembler is None:
        return _without_cameras()
    assembler = context.assembler
    problems, sizes = [], {}
    for camera in assembler.layout.names:
        calibration, picture = assembler.calibration(camera), context.pictures.get(camera)
        if calibration is None:
            problems.append(assembler.calibration_problem(camera) or "")
            continue
        sizes[camera] = "{}x{}".format(*calibration.image_size)
        if picture is not None and not isinstance(picture, str):
            seen = f"{picture.shape[1]}x{picture.shape[0]}"
            if seen != sizes[camera]:
                problems.append(f"camera {camera}: images of {seen}, but the calibration is for {sizes[camera]}")
    distinct = ", ".join(dict.fromkeys(sizes.values()))
    remedy = "calibrate the camera at the size that is recorded, or correct camera_info or the rig file"
    found = f"{len(sizes)} valid, of the images' size ({distinct})"
    changes = context.calibrations.changes if context.calibrations else []
    if changes and not problems:
        remedy = "take the parts before and after as two recordings"
        return CheckResult("warning", f"{found}; {'; '.join(changes[:_MAX_LISTED])}", remedy, {"changes": changes})
    return _judged(problems, remedy, found, {"sizes": sizes})


def check_transforms(context: CheckContext) -> CheckResult:
    """Look for each camera's pose in the base frame."""
    if context.contradiction is not None:
        remedy = "every frame needs one parent and one publisher, and those of cameras one fixed pose"
        return CheckResult("failed", context.contradiction, remedy)
    if context.assembler is None:
        return _without_cameras()
    assembler, base_frame = context.assembler, context.assembler.layout.base_frame
    problems = [problem for name in assembler.layout.names if (problem := assembler.transform_problem(name))]
    frames = assembler.transforms.frames
    passed, values = f"every camera is connected to {base_frame}", {"frames": frames}
    if assembler.frames_on_tf:
        passed += f" (on {MOVING_TRANSFORMS}, where they do not move: {', '.join(assembler.frames_on_tf)})"
    if not frames:
        remedy = f"record {STATIC_TRANSFORMS}, or give base_T_camera for every camera in a rig file (--rig)"
        about = assembler.about_transforms and f"; {assembler.about_transforms}"
        problems = [f"nothing on {STATIC_TRANSFORMS}{about}"] if problems else []
    elif frame_name(base_frame) not in frames:
        remedy = (
            f"name the vehicle's frame (--base-frame, or base_frame in the rig file); there are {', '.join(frames)}"
        )
        problems = [f"no frame is called {base_frame}"] if problems else []
    else:
        remedy = f"publish the missing transform on {STATIC_TRANSFORMS}, or give base_T_camera in a rig file (--rig)"
    return _judged(problems, remedy, passed, values)


def check_lenses(context: CheckContext) -> CheckResult:
    """Compare what each camera shows with what its lens sees, and the overlaps that come of it."""
    if context.rig is None or context.assembler is None:
        return CheckResult("skipped", "needs all cameras with calibration and transform")
    uses = lens_uses(context.assembler.completed_layout())
    values = {"lenses": [use._asdict() for use in uses]}
    wasted = [str(use) for use in uses if use.is_wasted]
    if wasted:
        remedy = "`cvcdepth rig BAG --view lens` writes a rig file (--rig) that shows all of each lens"
        return CheckResult("warning", "; ".join(wasted), remedy, values)
    angles = sorted({f"{use.lens:.0f}" for use in uses}, key=float)
    found = f"{len(uses)} of {' to '.join(dict.fromkeys((angles[0], angles[-1])))} degrees, shown whole"
    split = [f"{use.lens:.0f} degrees by {', '.join(use.cameras)}" for use in uses if len(use.cameras) > 1]
    return CheckResult("passed", "; ".join([found, *split]), values=values)


def check_encodings(context: CheckContext) -> CheckResult:
    """Decode the first image of each camera."""
    if context.assembler is None:
        return _without_cameras()
    pictures = context.pictures
    problems = [picture for picture in pictures.values() if isinstance(picture, str)]
    problems += [f"camera {name}: no image" for name in context.assembler.layout.names if name not in pictures]
    raw = "rgb8, bgr8, mono8, bayer_*, yuv422, nv12"
    remedy = f"record raw images ({raw}) or CompressedImage with whole JPEG or PNG files"
    return _judged(problems, remedy, f"the first image of {len(pictures)} cameras is decoded")


def _judged(problems: list[str], remedy: str, passed: str, values: Mapping[str, object] | None = None) -> CheckResult:
    values = {"problems": problems, **(values or {})}
    if problems:
        more = f"; and {len(problems) - _MAX_LISTED} more" if len(problems) > _MAX_LISTED else ""
        return CheckResult("failed", "; ".join(problems[:_MAX_LISTED]) + more, remedy, values)
    return CheckResult("passed", passed, values=values)


def _without_cameras() -> CheckResult:
    return CheckResult("skipped", "needs cameras, and transforms without contradictions")
