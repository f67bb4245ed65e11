# SPDX-License-Identifier: Apache-2.0
"""Recordings made ready for a run: motion that the pictures contradict is named and not learned from."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from recordings import JAZZY, Entry, changed, sample_entries, write_rosbag2

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.model_choices import checkpoint_path
from cvcdepth_core.training.config import MotionSource, RecordingsConfig
from cvcdepth_ros.checks import CHECKS
from cvcdepth_ros.finetuning.preparation import Prepared, Source, prepare
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.sample_choice import describe_motion


def there_and_back() -> Iterator[Entry]:
    """The sample's drive, and the same once more with time running backwards: twenty sets."""
    entries = sample_entries()
    end = max(entry.log_time for entry in entries) + 10**8
    yield from entries
    for entry in reversed(entries):
        message = JAZZY.deserialize_cdr(entry.cdr, entry.type)
        for part in getattr(message, "transforms", [message]):
            _mirror(part.header.stamp, end)
        yield entry._replace(log_time=2 * end - entry.log_time, cdr=bytes(JAZZY.serialize_cdr(message, entry.type)))


def _mirror(stamp: Any, end: int) -> None:
    stamp.sec, stamp.nanosec = divmod(2 * end - (stamp.sec * 10**9 + stamp.nanosec), 10**9)


def jumping(entries: Iterator[Entry]) -> Iterator[Entry]:
    """Odometry that is somewhere else from the twelfth set on, as when a map corrects it."""
    numbers = itertools.count()

    def move(message: Any) -> None:
        late = next(numbers) > 84  # 70 messages tell of the way there
        for part in message.transforms:
            part.transform.translation.x += 30.0 * late

    return changed(entries, "/tf", move)


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rosbag2(tmp_path_factory.mktemp("right") / "right", there_and_back())


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rosbag2(tmp_path_factory.mktemp("corrected") / "corrected", jumping(there_and_back()))


def prepared(recording: Path, run: Path, motion: MotionSource = "auto") -> Prepared:
    source = Source(
        [recording],
        None,
        MatchingSettings(),
        tuple(CHECKS),
        False,
        motion=motion,
        needs_ground=True,
        checkpoint=checkpoint_path(""),
    )
    return prepare(source, run)


def test_odometry_that_fits_the_pictures_is_learned_from(right: Path, tmp_path: Path):
    found = prepared(right, tmp_path)
    assert found.indexes[0].poses is not None
    assert not any("odometry" in warning for warning in found.warnings)


def test_odometry_that_the_pictures_contradict_is_named_and_the_pose_networks_motion_taken(
    corrected: Path, tmp_path: Path
):
    for _ in range(2):  # found, and kept
        found = prepared(corrected, tmp_path)
        (index,) = found.indexes
        assert index.poses is None
        assert len(index) == 19  # of twenty sets one falls apart where the way back begins
        told = describe_motion(index, RecordingsConfig(motion="auto"))
        assert told.startswith("pose network, for odometry jumps: its speed changes by ")
        assert any("odometry jumps" in warning and "so it is not used" in warning for warning in found.warnings)


def test_where_recorded_motion_is_insisted_on_a_recording_with_wrong_odometry_is_refused(
    corrected: Path, tmp_path: Path
):
    with pytest.raises(RecordingError, match="odometry jumps: its speed changes by"):
        prepared(corrected, tmp_path, motion="recorded")
