# SPDX-License-Identifier: Apache-2.0
"""The demo's parts that need no ROS: its processes, its folder, what counts as sent and received, the page."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bags import RecordingWriter, open_recording
from cvcdepth_ros.demo.recorded_lidar import RecordedLidar
from cvcdepth_ros.demo.result import DemoResult
from cvcdepth_ros.end_to_end.paths import DemoPaths
from cvcdepth_ros.end_to_end.processes import Child, Children, DemoError
from cvcdepth_ros.end_to_end.received import Output, ReceivedSets, SentSet, node_outputs, sent_sets
from cvcdepth_ros.messages.conversion import bag_message_factory
from cvcdepth_ros.messages.node_report import NodeReport
from cvcdepth_ros.recordings.rig import discover_rig
from cvcdepth_ros.reports.animation_page import animation_page

NODE = "/surround_depth"
TIMEOUT = 60.0


@pytest.fixture
def start_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Child]]:
    """Start Python text as a child of the demo."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    family = Children(tmp_path)

    def start(text: str) -> Child:
        (tmp_path / "a_program.py").write_text(text)
        return family.start("program", "a_program")

    yield start
    family.stop()


def test_a_process_that_ignores_signals_is_killed(
    start_program: Callable[[str], Child], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("cvcdepth_ros.end_to_end.processes._STOP_SECONDS", 0.2)
    ignore = "import signal\nfor s in (2, 15): signal.signal(s, signal.SIG_IGN)\n"
    child = start_program(ignore + "print('{}', flush=True)\nwhile True: signal.pause()")
    assert list(child.reports(TIMEOUT)) == [{}]
    child.stop()
    with pytest.raises(DemoError, match="program ended with code -9"):
        child.ended()


def test_a_document_is_found_behind_other_lines(start_program: Callable[[str], Child]):
    child = start_program("print('dds: an error')\nprint('{\\n  \"a\": 1\\n}')")
    assert child.ended(TIMEOUT)
    assert child.result() == {"a": 1}


def test_a_program_that_prints_no_document_is_named_with_its_last_lines(start_program: Callable[[str], Child]):
    child = start_program("print('something else')")
    assert child.ended(TIMEOUT)
    with pytest.raises(DemoError, match=r"program printed no JSON(.|\n)*something else"):
        child.result()


def test_the_domain_of_the_user_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "77")
    assert Children(tmp_path).domain == "77"
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert 1 <= int(Children(tmp_path).domain) <= 101


def test_what_the_demo_did_not_write_is_not_removed(tmp_path: Path):
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "drive.mcap").touch()
    with pytest.raises(ConfigError, match=r"recording was not written by the demo"):
        DemoPaths(tmp_path).prepare()
    assert (tmp_path / "recording" / "drive.mcap").exists()


def test_what_an_earlier_run_wrote_is_removed_and_the_rest_is_kept(tmp_path: Path):
    paths = DemoPaths(tmp_path)
    paths.prepare()
    for file in (paths.result, paths.sheets / "set_001.png", tmp_path / "notes.txt"):
        file.touch()
    paths.prepare()
    assert {path.name for path in tmp_path.iterdir()} == {"sets", "logs", "notes.txt", ".cvcdepth_demo"}
    assert not list(paths.sheets.iterdir())


# What counts as sent and received


@pytest.fixture(scope="module")
def layout() -> RigLayout:
    with open_recording(SAMPLE) as recording:
        return discover_rig(recording)


def sets_of_sample(layout: RigLayout, **fewer: int) -> list[SentSet]:
    """The sample's sets when of the named cameras only so many images are sent."""
    sent = {camera.image_topic: fewer.get(camera.name, 10) for camera in layout.cameras}
    with open_recording(SAMPLE) as recording:
        return sent_sets(recording, layout, 0.1, sent)


def test_a_set_counts_as_sent_only_with_all_its_images(layout: RigLayout):
    assert len(sets_of_sample(layout)) == 10
    assert len(sets_of_sample(layout, right=7)) == 7
    assert sets_of_sample(layout, back=0) == []


def write_outputs(
    folder: Path, outputs: list[Output], sets: list[SentSet], drop: Callable[[Output, int], bool]
) -> None:
    """What a recorder gets from a node that publishes these sets; `drop` says which messages are lost."""
    factory = bag_message_factory()
    depth, picture = np.full((4, 6), 5.0, dtype=np.float32), np.zeros((4, 6, 3), dtype=np.uint8)
    depth[0, 0] = np.nan
    cloud = np.array([[1, 2, 3, 0]], dtype=np.float32)
    cloud[:, 3] = np.array([0x112233], dtype=np.uint32).view(np.float32)
    with RecordingWriter(folder) as writer:
        for output in outputs:
            writer.add_topic(output.topic, output.type_name)
        for sent in sets:
            for output in outputs:
                stamp = sent.stamps_ns[output.camera]
                messages = {
                    "depth/image_rect": factory.depth_image(stamp, "f", depth, "32FC1"),
                    "image_rect": factory.colour_image(stamp, "f", picture),
                    "depth/camera_info": factory.camera_info(stamp, "f", np.eye(3), 4, 6),
                    "points": factory.point_cloud(stamp, "base_link", cloud),
                }
                if not drop(output, sent.sequence):
                    writer.write(output.topic, sent.stamp_ns, messages[output.part])


def test_a_set_counts_as_received_only_with_all_its_messages(tmp_path: Path, layout: RigLayout):
    outputs, sets = node_outputs(NODE, layout.names, "front"), sets_of_sample(layout)
    lost = f"{NODE}/left/depth/image_rect"
    write_outputs(tmp_path / "bag", outputs, sets, lambda output, index: output.topic == lost and index in (3, 8))
    received = ReceivedSets(tmp_path / "bag", outputs, sets)
    complete = list(received)
    assert [surround.sent.sequence for surround in complete] == [0, 1, 2, 4, 5, 6, 7, 9]
    assert received.missing == {3: [lost], 8: [lost]}
    first = complete[0]
    assert first.depth.shape == (6, 4, 6)
    assert np.isnan(first.depth[:, 0, 0]).all()
    assert (first.depth[:, 1:] == 5).all()
    assert first.pictures.shape == (6, 4, 6, 3)
    assert first.cloud.xyz.tolist() == [[1, 2, 3]]
    assert first.cloud.rgb.tolist() == [[0x11, 0x22, 0x33]]


def test_messages_with_stamps_that_nobody_sent_are_no_set(tmp_path: Path, layout: RigLayout):
    outputs, sets = node_outputs(NODE, layout.names, "front"), sets_of_sample(layout)
    write_outputs(tmp_path / "bag", outputs, sets, lambda output, index: False)
    others = ReceivedSets(tmp_path / "bag", outputs, sets[:4])
    assert len(list(others)) == 4
    assert others.foreign == {output.topic: 6 for output in outputs}


def test_the_lidar_is_there_for_every_set_of_the_sample(layout: RigLayout):
    with open_recording(SAMPLE) as recording:
        lidar = RecordedLidar(recording, layout)
        for sent in sets_of_sample(layout):
            points = lidar.at(sent.stamp_ns, sent.images["front"])
            assert points is not None
            assert len(points) > 20_000
            # The road, seen in the base frame, is below the cameras.
            assert np.percentile(points[:, 2], 20) < min(c.base_T_camera[2, 3] for c in layout.complete().cameras)


# The result


def result_of(sent: int, matched: int, published: int, received: int) -> DemoResult:
    node = NodeReport(sets={"matched": matched, "published": published, "replaced": matched - published})
    nothing: dict[str, Any] = {
        "incomplete": {},
        "never_sent": {},
        "messages_received": {},
        "messages_lost": {},
        "parameters": {},
    }
    counts = {"sent": sent, "received": received, "images_sent": 6 * sent}
    return DemoResult(version="0", recording="bag", rate=1, untrained=True, node=node, **counts, **nothing)


def test_a_run_is_good_when_all_was_matched_and_all_that_was_published_arrived():
    assert result_of(10, 10, 10, 10).problems() == []
    assert result_of(10, 10, 7, 7).problems() == []
    assert "3 replaced" in result_of(10, 10, 7, 7).text()


@pytest.mark.parametrize(
    ("counts", "problem"),
    [
        ((10, 9, 9, 9), "10 sets were sent complete, but 9 matched"),
        ((10, 10, 10, 9), "10 sets were published, but 9 received"),
        ((10, 10, 0, 0), "no set was published: 10 replaced"),
        ((0, 0, 0, 0), "the recording has no set"),
    ],
)
def test_a_run_is_bad_when_sets_went_missing(counts: tuple[int, int, int, int], problem: str):
    assert any(problem in found for found in result_of(*counts).problems())


def test_the_page_shows_text_as_text():
    evil = "<script>alert('x')</script>"
    page = animation_page(evil, evil, [b"jpeg"], [(evil, [(evil, evil)])], [evil])
    assert page.count("<script>") == 1
    assert page.count("&lt;script&gt;alert(&#x27;x&#x27;)&lt;/script&gt;") == 7
