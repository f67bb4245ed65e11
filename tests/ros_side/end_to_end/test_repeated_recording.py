# SPDX-License-Identifier: Apache-2.0
import numpy as np
from recordings import SAMPLE

from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.end_to_end.repeated_recording import write_repeated
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.recordings.rig import discover_rig


def test_a_short_recording_goes_on_at_its_own_pace_with_later_stamps(tmp_path):
    with open_recording(SAMPLE) as source:
        layout = discover_rig(source)
        write_repeated(source, layout, tmp_path / "long", 2.5)
        topic = layout.cameras[0].image_topic
        original = [source.deserialize(m) for m in source.messages([topic])]
    with open_recording(tmp_path / "long") as recording:
        repeated = [recording.deserialize(m) for m in recording.messages([topic])]
        infos = sum(1 for _ in recording.messages([layout.cameras[0].camera_info_topic]))
    assert len(repeated) == infos == 3 * len(original)
    stamps = np.array([stamp_ns(message) for message in repeated])
    np.testing.assert_allclose(np.diff(stamps) / 1e9, 0.1, atol=0.02)
    assert stamps[: len(original)].tolist() == [stamp_ns(message) for message in original]
    assert repeated[-1].header.frame_id == original[-1].header.frame_id
    np.testing.assert_array_equal(repeated[-1].data, original[-1].data)
