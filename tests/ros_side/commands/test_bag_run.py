# SPDX-License-Identifier: Apache-2.0
"""`bag_replay run`: the recording of depth, read with the rosbags library alone."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recordings
import yaml
from numpy.typing import NDArray
from recordings import CAMERAS, JAZZY, SAMPLE, Entry
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording

SMALL = ("--untrained", "--height", "64", "--width", "96")
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

Messages = dict[str, list[Any]]


def run(recording: Path, output: Path, *options: str) -> Path:
    assert main(["run", str(recording), "-o", str(output), *SMALL, *options]) == 0
    return output


def refusal(recording: Path, output: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """What the program says on a failure: one line. No output is left."""
    assert main(["run", str(recording), "-o", str(output), *SMALL, *options]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: untrained")]
    assert len(lines) == 1
    assert not output.exists()
    return lines[0]


def read(path: Path) -> Messages:
    found: Messages = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            found[connection.topic].append(reader.deserialize(raw, connection.msgtype))
    return found


def result_of(output: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((output / "run.json").read_text())
    return content


def depth_of(image: Any) -> NDArray[np.float32]:
    assert image.encoding == "32FC1"
    assert image.step == 4 * image.width
    return image.data.view(np.float32).reshape(image.height, image.width)


def depths(path: Path) -> list[NDArray[np.float32]]:
    messages = read(path)
    return [depth_of(image) for name in CAMERAS for image in messages[f"/surround_depth/{name}/depth/image_rect"]]


def assert_same_depth(left: Path, right: Path) -> None:
    for a, b in zip(depths(left), depths(right), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's depth, with all clouds."""
    return run(SAMPLE, tmp_path_factory.mktemp("whole") / "depth", "--clouds", "all")


@pytest.fixture(scope="module")
def messages(whole: Path) -> Messages:
    return read(whole)


@pytest.fixture(scope="module")
def two_sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The depth of the sample's first two sets."""
    folder = tmp_path_factory.mktemp("two_sets")
    return run(recordings.write_rosbag2(folder / "recording", recordings.sample_entries(2)), folder / "depth")


def test_the_same_recording_twice_gives_the_same_messages_to_the_bit(two_sets: Path, tmp_path: Path):
    again = run(recordings.write_rosbag2(tmp_path / "recording", recordings.sample_entries(2)), tmp_path / "depth")
    found = []
    for path in (two_sets, again):
        with open_recording(path) as recording:
            found.append([(m.topic, m.log_time, bytes(m.cdr)) for m in recording.messages()])
    assert len(found[0]) > 2 * len(CAMERAS)
    assert found[0] == found[1]


def test_every_set_of_the_sample_is_written(whole: Path, messages: Messages):
    for name in CAMERAS:
        for part in ("depth/image_rect", "depth/camera_info", "image_rect", "points"):
            assert len(messages[f"/surround_depth/{name}/{part}"]) == 10
    assert len(messages["/surround_depth/points"]) == 10
    assert result_of(whole)["sets"] == {"written": 10, "matched": 10, "incomplete": 0, "refused": 0}


def test_what_belongs_to_a_camera_carries_its_images_stamps_and_frame(messages: Messages):
    recorded = read(SAMPLE)
    for name in CAMERAS:
        stamps = [image.header.stamp for image in recorded[f"/camera/{name}/image_raw/compressed"]]
        for part in ("depth/image_rect", "depth/camera_info", "image_rect", "points"):
            headers = [message.header for message in messages[f"/surround_depth/{name}/{part}"]]
            assert [header.stamp for header in headers] == stamps
            assert {header.frame_id for header in headers} == {f"{name}_camera_optical_frame"}


def test_the_merged_cloud_carries_the_anchors_stamp_and_the_base_frame(messages: Messages):
    clouds = messages["/surround_depth/points"]
    assert [c.header.stamp for c in clouds] == [
        d.header.stamp for d in messages["/surround_depth/front/depth/image_rect"]
    ]
    assert {cloud.header.frame_id for cloud in clouds} == {"base_link"}
    assert all(cloud.height == 1 and cloud.width > 1000 for cloud in clouds)


def test_outputs_lie_at_the_log_times_of_their_images(whole: Path):
    assert log_times(whole, "/surround_depth/left/depth/image_rect") == log_times(
        SAMPLE, "/camera/left/image_raw/compressed"
    )


def log_times(path: Path, topic: str) -> list[int]:
    with Reader(path) as reader:
        return [time_ for _, time_, _ in reader.messages([c for c in reader.connections if c.topic == topic])]


def test_a_stranger_rebuilds_the_organised_cloud_from_depth_and_camera_info(messages: Messages):
    for name in CAMERAS:
        topic = f"/surround_depth/{name}"
        depth = depth_of(messages[f"{topic}/depth/image_rect"][3])
        info, cloud = messages[f"{topic}/depth/camera_info"][3], messages[f"{topic}/points"][3]
        picture = messages[f"{topic}/image_rect"][3]
        assert (info.height, info.width) == (cloud.height, cloud.width) == depth.shape == (64, 96)
        np.testing.assert_allclose(xyz_of(cloud), back_projected(depth, info), atol=1e-3)
        colours = cloud.data.view(np.uint32).reshape(64, 96, 4)[..., 3]
        rgb = np.stack([colours >> 16 & 255, colours >> 8 & 255, colours & 255], axis=-1)
        np.testing.assert_array_equal(rgb, picture.data.reshape(64, 96, 3))


def back_projected(depth: NDArray[np.float32], info: Any) -> NDArray[np.float64]:
    """As depth_image_proc does: with P, pixel centres at the integers."""
    fx, cx, fy, cy = info.p[0], info.p[2], info.p[5], info.p[6]
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    depth = np.where(np.isfinite(depth), depth, np.nan)  # the sky is inf
    return np.stack([(u - cx) * depth / fx, (v - cy) * depth / fy, depth], axis=-1)


def xyz_of(cloud: Any) -> NDArray[np.float32]:
    offsets = {field.name: field.offset for field in cloud.fields}
    assert [offsets[name] for name in "xyz"] == [0, 4, 8]
    assert not cloud.is_bigendian
    return cloud.data.view(np.float32).reshape(cloud.height, cloud.width, cloud.point_step // 4)[..., :3]


def test_the_cloud_option_chooses_which_clouds_are_stored(whole: Path, two_sets: Path, tmp_path: Path):
    none = run(recordings.lone_mcap(tmp_path / "lone.mcap"), tmp_path / "none", "--clouds", "none", "--duration", "0.2")
    found = {path: {topic for topic in read(path) if topic.endswith("/points")} for path in (whole, two_sets, none)}
    assert len(found[whole]) == 7
    assert found[two_sets] == {"/surround_depth/points"}
    assert not found[none]


def test_the_transforms_of_the_recording_are_there(messages: Messages):
    recorded = read(SAMPLE)
    assert links(messages["/tf_static"]) == links(recorded["/tf_static"])
    assert [links([m]) for m in messages["/tf"]] == [links([m]) for m in recorded["/tf"]]


def links(transforms: Iterable[Any]) -> dict[str, tuple[str, list[float]]]:
    found = {}
    for link in (link for message in transforms for link in message.transforms):
        t, q = link.transform.translation, link.transform.rotation
        found[link.child_frame_id] = link.header.frame_id, [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
    return found


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    assert main(["rig", str(SAMPLE), "-o", str(path)]) == 0
    return path


def test_the_rig_files_pose_wins_over_the_recorded_one(rig_file: Path, tmp_path: Path):
    content = yaml.safe_load(rig_file.read_text())
    content["cameras"][2]["base_T_camera"]["translation"] = [7.0, 8.0, 9.0]
    moved = tmp_path / "moved.yaml"
    moved.write_text(yaml.safe_dump(content))
    output = links(read(run(SAMPLE, tmp_path / "depth", "--rig", str(moved), "--duration", "0.2"))["/tf_static"])
    recorded = links(read(SAMPLE)["/tf_static"])
    assert output.pop("left_camera_optical_frame")[1][:3] == [7.0, 8.0, 9.0]
    assert output == {frame: link for frame, link in recorded.items() if frame != "left_camera_optical_frame"}


def test_a_rig_file_serves_a_recording_that_has_neither_transforms_nor_camera_info(
    rig_file: Path, two_sets: Path, tmp_path: Path
):
    kept = [e for e in recordings.sample_entries(2) if e.type == COMPRESSED]
    output = run(recordings.write_rosbag2(tmp_path / "images", kept), tmp_path / "depth", "--rig", str(rig_file))
    assert_same_depth(output, two_sets)
    written = links(read(output)["/tf_static"])
    recorded = links(read(SAMPLE)["/tf_static"])
    for name in CAMERAS:
        parent, pose = written[f"{name}_camera_optical_frame"]
        assert parent == "base_link"
        np.testing.assert_allclose(pose[:3], recorded[f"{name}_camera_optical_frame"][1][:3], atol=1e-9)


@pytest.mark.parametrize("storage", ["sqlite", "ros1.bag", "split"])
def test_depth_does_not_depend_on_how_the_recording_stores_the_same_pixels(
    storage: str, two_sets: Path, tmp_path: Path
):
    make = {
        "sqlite": lambda path: recordings.sqlite_copy(path, 2),
        "ros1.bag": lambda path: recordings.ros1_copy(path, 2),
        "split": lambda path: recordings.split_copy(path, 3, 2),
    }
    assert_same_depth(run(make[storage](tmp_path / storage), tmp_path / "depth"), two_sets)


def test_raw_images_give_the_depth_of_the_jpeg_that_they_were_decoded_from(tmp_path: Path):
    """Exactly so where the network is too fine for the JPEG decoder to reduce the pictures."""
    fine = ("--height", "192", "--width", "320")
    jpeg = recordings.write_rosbag2(tmp_path / "jpeg", recordings.sample_entries(1))
    expected = run(jpeg, tmp_path / "expected", *fine)
    for encoding in ("bgr8", "rgb8"):
        raw = recordings.raw_copy(tmp_path / encoding, encoding, 1)
        assert_same_depth(run(raw, tmp_path / f"{encoding}_depth", *fine), expected)


@pytest.mark.parametrize(
    ("encoding", "to_bgr"), [("mono8", cv2.COLOR_GRAY2BGR), ("bayer_rggb8", cv2.COLOR_BayerRGGB2BGR)]
)
def test_grey_and_mosaic_images_give_the_depth_of_the_colours_that_they_stand_for(
    encoding: str, to_bgr: int, tmp_path: Path
):
    raw = list(recordings.with_raw_images(recordings.sample_entries(1), encoding))
    source = run(recordings.write_rosbag2(tmp_path / encoding, raw), tmp_path / "depth")
    shown = run(recordings.write_rosbag2(tmp_path / "bgr8", as_bgr(raw, to_bgr)), tmp_path / "shown")
    assert_same_depth(source, shown)


def as_bgr(entries: Iterable[Entry], conversion: int) -> Iterator[Entry]:
    for entry in entries:
        if entry.type == IMAGE:
            image: Any = JAZZY.deserialize_cdr(entry.cdr, entry.type)
            pixels = cv2.cvtColor(image.data.reshape(image.height, image.width), conversion)
            image.encoding, image.step, image.data = "bgr8", 3 * image.width, pixels.reshape(-1)
            entry = entry._replace(cdr=bytes(JAZZY.serialize_cdr(image, entry.type)))
        yield entry


def test_unknown_depth_is_nan_or_zero_millimetres(rig_file: Path, tmp_path: Path):
    mask = np.full((540, 960), 255, np.uint8)
    mask[270:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    content = yaml.safe_load(rig_file.read_text())
    content["cameras"][3]["mask"] = "mask.png"
    masked = tmp_path / "masked.yaml"
    masked.write_text(yaml.safe_dump(content))
    options = ("--rig", str(masked), "--duration", "0.2")
    metres = depth_of(read(run(SAMPLE, tmp_path / "metres", *options))["/surround_depth/back/depth/image_rect"][0])
    encoded = run(SAMPLE, tmp_path / "millimetres", *options, "--depth-encoding", "16UC1")
    image = read(encoded)["/surround_depth/back/depth/image_rect"][0]
    millimetres = image.data.view(np.uint16).reshape(64, 96)
    assert image.encoding == "16UC1"
    known = slice(5, 32)  # above is the border of a picture that is wider than the network's, below the mask
    assert np.isfinite(metres[known]).all()
    assert np.isnan(np.delete(metres, known, axis=0)).all()
    np.testing.assert_allclose(millimetres[known], 1000 * metres[known], atol=0.51)
    assert not np.delete(millimetres, known, axis=0).any()


def test_a_part_of_the_recording_can_be_chosen(tmp_path: Path):
    output = run(SAMPLE, tmp_path / "depth", "--start", "0.3", "--duration", "0.4")
    (first, *_), start = read(output)["/tf_static"], log_times(SAMPLE, "/tf_static")[0]
    assert first
    assert result_of(output)["sets"]["written"] in (3, 4)
    assert all(start + 3e8 <= time_ < start + 7e8 for time_ in log_times(output, "/surround_depth/points"))
    assert all(start + 3e8 <= time_ < start + 7e8 for time_ in log_times(output, "/tf"))


def test_a_damaged_image_is_named_and_costs_one_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    entries = recordings.sample_entries(3)
    index = [i for i, e in enumerate(entries) if e.topic == "/camera/right/image_raw/compressed"][1]
    image: Any = JAZZY.deserialize_cdr(entries[index].cdr, COMPRESSED)
    image.data = image.data[:2000]
    entries[index] = entries[index]._replace(cdr=bytes(JAZZY.serialize_cdr(image, COMPRESSED)))
    output = run(recordings.write_rosbag2(tmp_path / "damaged", entries), tmp_path / "depth")
    assert len(read(output)["/surround_depth/points"]) == 2
    result = result_of(output)
    assert result["sets"] == {"written": 2, "matched": 3, "incomplete": 0, "refused": 1}
    (reason,) = result["refused"]
    assert "camera right" in reason
    assert "was cut" in reason
    assert reason in capsys.readouterr().out


def test_bytes_that_are_no_image_message_cost_their_set_only(tmp_path: Path):
    entries = recordings.sample_entries(3)
    index = [i for i, e in enumerate(entries) if e.topic == "/camera/left/image_raw/compressed"][2]
    entries[index] = entries[index]._replace(cdr=entries[index].cdr[:30])
    result = result_of(run(recordings.write_rosbag2(tmp_path / "damaged", entries), tmp_path / "depth"))
    assert result["sets"]["written"] == 2
    assert "camera left" in result["refused"][0]


def test_a_camera_info_that_cannot_be_read_costs_no_set_and_is_told(tmp_path: Path):
    entries = recordings.sample_entries(3)
    index = [i for i, e in enumerate(entries) if e.topic == "/camera/left/camera_info"][1]
    entries[index] = entries[index]._replace(cdr=entries[index].cdr[:40])
    result = result_of(run(recordings.write_rosbag2(tmp_path / "damaged", entries), tmp_path / "depth"))
    assert result["sets"] == {"written": 3, "matched": 3, "incomplete": 0, "refused": 0}
    (reason,) = result["refused"]
    assert "/camera/left/camera_info at" in reason


def test_sets_are_refused_by_name_while_a_camera_calls_itself_uncalibrated(rig_file: Path, tmp_path: Path):
    content = yaml.safe_load(rig_file.read_text())
    del content["cameras"][3]["calibration"]
    open_rig = tmp_path / "open.yaml"
    open_rig.write_text(yaml.safe_dump(content))
    entries = recordings.sample_entries(4)
    times = sorted(e.log_time for e in entries if e.topic == "/camera/back/camera_info")

    def is_late(entry: Entry) -> bool:
        return entry.log_time >= times[2]

    def uncalibrate(message: Any) -> None:
        message.k = np.zeros(9)

    late = recordings.changed([e for e in entries if is_late(e)], "/camera/back/camera_info", uncalibrate)
    recording = recordings.write_rosbag2(tmp_path / "lost", [*(e for e in entries if not is_late(e)), *late])
    result = result_of(run(recording, tmp_path / "depth", "--rig", str(open_rig)))
    assert 0 < result["sets"]["written"] < 4
    assert result["sets"]["refused"] == 4 - result["sets"]["written"]
    assert "camera back: camera_info: K[0] = 0" in result["refused"][0]


def test_without_any_set_the_cameras_that_prevent_it_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    line = refusal(SAMPLE, tmp_path / "depth", capsys, "--tolerance", "0.02")
    assert "images of back and right are 0.08" in line
    assert "tolerance is 0.02" in line
    line = refusal(SAMPLE, tmp_path / "depth", capsys, "--start", "5")
    assert "no image of camera front" in line


def test_the_result_says_what_was_done_with_what(whole: Path):
    result = result_of(whole)
    assert result["recording"] == str(SAMPLE)
    assert result["version"]
    assert "random weights" in result["model"]
    assert (result["configuration"]["height"], result["configuration"]["tolerance"]) == (64, 0.1)
    assert [camera["name"] for camera in result["configuration"]["cameras"]] == list(CAMERAS)
    assert result["images"]["back"]["received"] == result["images"]["back"]["matched"] == 10
    assert {"decode", "preprocess", "inference", "write", "total"} <= result["seconds"].keys()


def test_an_existing_output_is_not_touched(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "kept.txt").write_text("precious")
    assert main(["run", str(SAMPLE), "-o", str(tmp_path), *SMALL]) == 1
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "kept.txt").read_text() == "precious"


def test_a_topic_of_the_rig_file_that_the_recording_lacks_is_named(
    rig_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    raw = recordings.raw_copy(tmp_path / "raw", "bgr8", 1)
    line = refusal(raw, tmp_path / "depth", capsys, "--rig", str(rig_file))
    assert "camera front: no topic /camera/front/image_raw/compressed" in line


def test_an_interrupted_run_leaves_a_recording_that_can_be_opened(tmp_path: Path):
    output = tmp_path / "depth"
    command = [sys.executable, "-m", "cvcdepth_ros.bag_replay", "run", str(SAMPLE), "-o", str(output)]
    process = subprocess.Popen(
        [*command, "--untrained", "--height", "192", "--width", "320"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    while not list(output.glob("*.mcap")):
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert b"interrupted" in errors
    assert b"Traceback" not in errors
    written = result_of(output)["sets"]["written"]
    assert 0 < written < 10
    assert len(read(output)["/surround_depth/points"]) == written
