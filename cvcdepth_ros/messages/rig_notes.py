# SPDX-License-Identifier: Apache-2.0
"""What is odd about a recording's cameras, told to who makes a rig of them."""

from contextlib import suppress

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages.camera_info import read_camera_info
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras, first_camera_info
from cvcdepth_ros.messages.recorded_changes import find_calibration_changes
from cvcdepth_ros.messages.transform_topics import describe_transform_topics


def rig_notes(recording: Recording, layout: RigLayout) -> list[str]:
    """Return how cameras were chosen, CameraInfos and transforms understood, and what changes on the way, a line each.

    `layout` is the rig that was made; it is of the beginning of the recording.
    """
    found = find_recorded_cameras(recording)
    changes = find_calibration_changes(recording, layout)
    about = describe_transform_topics(recording)
    return [
        *recording.notes,
        *found.choices,
        *found.left_out,
        *_camera_info_notes(recording, layout),
        *(f"{change}; the rig is that of what comes before" for change in changes),
        *([about] if about else []),
    ]


def _camera_info_notes(recording: Recording, layout: RigLayout) -> list[str]:
    notes = []
    for camera in layout.cameras:
        with suppress(RecordingError, RigError):
            info = first_camera_info(recording, camera.camera_info_topic)
            read = read_camera_info(info, camera.name) if info is not None else None
            notes += [f"camera {camera.name}: camera_info: {note}" for note in (read.notes if read else ())]
    return notes
