# SPDX-License-Identifier: Apache-2.0
"""Reading and writing recordings. Nothing here imports ROS."""

from cvcdepth_ros.bags.discovery import find_recordings
from cvcdepth_ros.bags.recording import Recording, open_recording
from cvcdepth_ros.bags.remote import Location, RemotePath, file_identities
from cvcdepth_ros.bags.topics import LATCHED, RecordedMessage, Topic, qos_profile
from cvcdepth_ros.bags.typestores import typestore
from cvcdepth_ros.bags.writer import RecordingWriter

__all__ = [
    "LATCHED",
    "Location",
    "RecordedMessage",
    "Recording",
    "RecordingWriter",
    "RemotePath",
    "Topic",
    "file_identities",
    "find_recordings",
    "open_recording",
    "qos_profile",
    "typestore",
]
