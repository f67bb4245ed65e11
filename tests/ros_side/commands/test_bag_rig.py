# SPDX-License-Identifier: Apache-2.0
"""`bag_replay rig`: the rig file of a recording."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recordings
from recordings import CAMERAS, JAZZY, SAMPLE

from cvcdepth_core.rig.rig_file import PoseEntry, load_rig_layout, save_rig_layout
from cvcdepth_ros.bag_replay import main


def write_rig(recording: Path, output: Path, *options: str) -> Path:
    assert main(["rig", str(recording), "-o", str(output), *options]) == 0
    return output


def refusal(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """What the program says; it must be one line, and no rig file may be left."""
    output = tmp_path / "refused.yaml"
    assert main(["rig", str(recording), "-o", str(output), *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert not output.exists()
    return line


def test_the_cameras_are_ordered_around_the_vehicle_from_the_front_one(tmp_path: Path):
    layout = load_rig_layout(write_rig(SAMPLE, tmp_path / "rig.yaml"))
    assert tuple(layout.names) == CAMERAS
    assert layout.anchor == "front"
    assert layout.base_frame == "base_link"


def test_neighbours_and_overlap_angles_are_those_of_the_vehicle(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_rig(SAMPLE, tmp_path / "rig.yaml", "--json")
    result = json.loads(capsys.readouterr().out)
    degrees = {(o["camera"], o["neighbour"]): o["degrees"] for o in result["overlaps"] if o["are_neighbours"]}
    expected = {
        ("front", "front_left"): 14,
        ("front", "front_right"): 14,
        ("front_left", "left"): 58,
        ("left", "back"): 4,
    }
    for (camera, neighbour), angle in expected.items():
        assert degrees[camera, neighbour] == pytest.approx(angle, abs=1)
        assert degrees[neighbour, camera] == pytest.approx(angle, abs=1)
    assert ("back", "right") not in degrees
    views = {camera["name"]: camera["horizontal_view_degrees"] for camera in result["cameras"]}
    assert views == pytest.approx(dict.fromkeys(CAMERAS, 92) | {"front": 52}, abs=0.6)


def test_the_rig_file_alone_is_a_complete_rig(tmp_path: Path):
    rig = load_rig_layout(write_rig(SAMPLE, tmp_path / "rig.yaml")).complete()
    (static,) = (e for e in recordings.sample_entries(1) if e.topic == "/tf_static")
    message: Any = JAZZY.deserialize_cdr(static.cdr, static.type)
    recorded = {link.child_frame_id: link.transform.translation for link in message.transforms}
    for camera in rig.cameras:
        t = recorded[f"{camera.name}_camera_optical_frame"]
        np.testing.assert_allclose(camera.base_T_camera[:3, 3], [t.x, t.y, t.z], atol=1e-12)


def test_the_file_says_where_it_comes_from_and_which_cameras_overlap(tmp_path: Path):
    text = write_rig(SAMPLE, tmp_path / "rig.yaml").read_text()
    comment = [line for line in text.splitlines() if line.startswith("#")]
    assert "pandaset_002_excerpt" in comment[0]
    assert any("left - back: 4." in line for line in comment)


def test_every_storage_gives_the_same_rig(tmp_path: Path):
    ground = ("--ground-height", "-0.3")  # else by the LiDAR, whose sweeps are not all copied
    expected = load_rig_layout(write_rig(SAMPLE, tmp_path / "expected.yaml", *ground))
    copies = [recordings.sqlite_copy(tmp_path / "sqlite", 1), recordings.ros1_copy(tmp_path / "ros1.bag", 1)]
    for copy in copies:
        assert load_rig_layout(write_rig(copy, tmp_path / f"{copy.stem}.yaml", *ground)) == expected


def test_a_rig_file_is_only_overwritten_by_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    existing = tmp_path / "rig.yaml"
    existing.write_text("precious")
    assert main(["rig", str(SAMPLE), "-o", str(existing)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert existing.read_text() == "precious"
    write_rig(SAMPLE, existing, "--force")
    assert load_rig_layout(existing).names


def test_a_mask_made_by_hand_is_only_overwritten_by_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    mask = tmp_path / "refused_masks" / "back.png"
    mask.parent.mkdir()
    mask.write_bytes(b"made by hand")
    assert "back.png: exists already; --force overwrites it" in refusal(SAMPLE, tmp_path, capsys, "--masks")
    assert mask.read_bytes() == b"made by hand"
    write_rig(SAMPLE, tmp_path / "refused.yaml", "--masks", "--force")
    assert mask.read_bytes().startswith(b"\x89PNG")


def test_cameras_of_which_none_sees_ground_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def look_up(message: Any) -> None:
        for link in message.transforms:
            q = link.transform.rotation
            q.x, q.y, q.z, q.w = 0.0, 0.0, 0.0, 1.0  # as a body frame: z up

    entries = recordings.changed(recordings.sample_entries(), "/tf_static", look_up)
    body = recordings.write_rosbag2(tmp_path / "body", entries)
    line = refusal(body, tmp_path, capsys, "--masks", "--anchor", "front", "--ground-height", "0")
    assert f"camera {', '.join(sorted(CAMERAS))}: none sees ground" in line


def test_the_anchor_can_be_chosen_among_the_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert load_rig_layout(write_rig(SAMPLE, tmp_path / "rig.yaml", "--anchor", "back")).anchor == "back"
    capsys.readouterr()
    assert "no camera is called top" in refusal(SAMPLE, tmp_path, capsys, "--anchor", "top")


def test_a_recording_without_cameras_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    entries = [entry for entry in recordings.sample_entries(1) if not entry.topic.startswith("/camera")]
    line = refusal(recordings.write_rosbag2(tmp_path / "no_cameras", entries), tmp_path, capsys)
    assert "no_cameras" in line
    assert "found 0" in line


def test_an_uncalibrated_camera_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def uncalibrate(message: Any) -> None:
        message.k = np.zeros(9)

    entries = recordings.changed(recordings.sample_entries(1), "/camera/left/camera_info", uncalibrate)
    line = refusal(recordings.write_rosbag2(tmp_path / "uncalibrated", entries), tmp_path, capsys)
    assert "camera left" in line
    assert "K[0] = 0" in line


def test_an_unknown_distortion_model_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def unknown(message: Any) -> None:
        message.distortion_model = "double_sphere"

    entries = recordings.changed(recordings.sample_entries(1), "/camera/back/camera_info", unknown)
    line = refusal(recordings.write_rosbag2(tmp_path / "unknown", entries), tmp_path, capsys)
    assert "camera back" in line
    assert "double_sphere" in line


def test_a_missing_transform_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def forget(message: Any) -> None:
        message.transforms = [link for link in message.transforms if not link.child_frame_id.startswith("right")]

    entries = recordings.changed(recordings.sample_entries(1), "/tf_static", forget)
    line = refusal(recordings.write_rosbag2(tmp_path / "no_transform", entries), tmp_path, capsys)
    assert "right_camera_optical_frame" in line
    assert "base_footprint" in refusal(SAMPLE, tmp_path, capsys, "--base-frame", "base_footprint")


def test_masks_come_with_their_share_and_a_picture_to_look_at_and_need_no_overlap(tmp_path, capsys):
    """Two cameras that share no view: depth cannot be learnt from them, but their own vehicle can be seen."""
    others = [f"/camera/{name}/" for name in CAMERAS if name not in ("front", "back")]
    apart = recordings.write_mcap(tmp_path / "apart.mcap", recordings.without(recordings.sample_entries(), *others))
    path = tmp_path / "rig.yaml"
    assert main(["rig", str(apart), "-o", str(path), "--masks", "--json"]) == 0
    said = capsys.readouterr()
    cameras = {camera["name"]: camera for camera in json.loads(said.out)["cameras"]}
    assert cameras["front"]["mask"] is None
    assert 0.15 < cameras["back"]["masked_share"] < 0.3
    overlay = cv2.imread(str(tmp_path / "rig_masks" / "back_overlay.jpg"))
    red = overlay[..., 2].astype(int) - overlay[..., 1] > 60
    assert abs(red.mean() - cameras["back"]["masked_share"]) < 0.02
    assert "camera back: its mask takes" in said.err
    assert (
        f"of where the vehicle drives in its picture: look at {tmp_path / 'rig_masks' / 'back_overlay.jpg'}" in said.err
    )


def test_too_short_a_recording_is_said_to_be_too_short_for_masks(tmp_path, capsys):
    short = recordings.write_mcap(tmp_path / "short.mcap", recordings.sample_entries(sets=4))
    assert main(["rig", str(short), "-o", str(tmp_path / "rig.yaml"), "--masks"]) == 0
    error = capsys.readouterr().err
    assert "short.mcap: no masks: " in error
    assert "pairs of pictures between which the vehicle moved 0.5 m, to look for its own body 8 are needed" in error


def test_a_camera_that_is_turned_against_its_mount_is_found_and_turned_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    layout = load_rig_layout(write_rig(SAMPLE, tmp_path / "rig.yaml"))
    pitched = np.eye(4)
    pitched[:3, :3] = cv2.Rodrigues(np.radians([0.8, 0.0, 0.0]))[0]
    cameras = [
        camera.model_copy(update={"base_T_camera": PoseEntry.from_matrix(camera.base_T_camera.matrix("") @ pitched)})
        if camera.name == "front_left"
        else camera
        for camera in layout.cameras
    ]
    save_rig_layout(tmp_path / "turned.yaml", layout.model_copy(update={"cameras": tuple(cameras)}), "")
    capsys.readouterr()
    refined = write_rig(SAMPLE, tmp_path / "refined.yaml", "--rig", str(tmp_path / "turned.yaml"), "--refine", "--json")
    told = json.loads(capsys.readouterr().out)["refined"]
    turn = np.array(told["turns"]["front_left"])
    np.testing.assert_allclose(turn, [-0.8, 0.1, 0.0], atol=0.4)  # half of it: as good as the default model's depth
    assert told["turns"]["front"] == [0.0, 0.0, 0.0]
    pair = next(p for p in told["pairs"] if (p["camera"], p["neighbour"]) == ("left", "front_left"))
    assert pair["after"] > pair["before"] + 0.1
    mounts = [load_rig_layout(path).complete().cameras[1].base_T_camera for path in (tmp_path / "rig.yaml", refined)]
    apart = np.degrees(np.linalg.norm(cv2.Rodrigues(mounts[0][:3, :3].T @ mounts[1][:3, :3])[0]))
    assert apart < 0.6


@pytest.mark.parametrize(
    ("sets", "reason"),
    [
        (2, "2 sets, more than 4 in a row are needed to compare pictures"),
        (5, "--refine: no pair of neighbours tells how its cameras are turned: "),
    ],
)
def test_pictures_that_do_not_tell_how_cameras_are_turned_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sets: int, reason: str
):
    grey = cv2.imencode(".jpg", np.full((540, 960, 3), 90, np.uint8))[1].ravel()
    entries = recordings.sample_entries(sets)
    for camera in CAMERAS:
        topic = f"/camera/{camera}/image_raw/compressed"
        entries = list(recordings.changed(entries, topic, lambda message: setattr(message, "data", grey)))
    assert reason in refusal(recordings.write_rosbag2(tmp_path / "grey", entries), tmp_path, capsys, "--refine")
