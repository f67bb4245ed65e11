# SPDX-License-Identifier: Apache-2.0
"""A rig file says what it means or is refused by name; overlaps and neighbours follow from the cameras' geometry."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from repository import ROOT
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cvcdepth_core.errors import RigError, TransformError
from cvcdepth_core.rig.calibration import Calibration, RegionOfInterest
from cvcdepth_core.rig.poses import Pose, pose_from_quaternion
from cvcdepth_core.rig.rig import MIN_NEIGHBOUR_OVERLAP_DEG, Camera, Rig, order_around_vehicle, overlap_angle
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout, load_rig_layout, save_rig_layout

SAMPLE = ROOT / "samples" / "pandaset_002_excerpt"
RIG_FILES = sorted((ROOT / "config" / "rigs").glob("*.yaml"))

# The method's table (section 1): cameras in order, and the same neighbours for both datasets.
METHOD_CAMERAS = {
    "ddad": ["camera_01", "camera_05", "camera_06", "camera_07", "camera_08", "camera_09"],
    "nuscenes": ["CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"],
}
METHOD_NEIGHBOURS = {0: [1, 2], 1: [0, 3], 2: [0, 4], 3: [1, 5], 4: [2, 5], 5: [3, 4]}
PANDASET_CAMERAS = ["front", "front_left", "left", "back", "right", "front_right"]


def _rotation_about(axis: str, degrees: float) -> NDArray[np.float64]:
    turn = np.eye(3)
    a, b = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn[a, a], turn[a, b], turn[b, a], turn[b, b] = c, -s, s, c
    return turn


# An optical frame (z forward, x right, y down) in a base frame (x forward, y left, z up).
LOOKING_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _pose(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Pose:
    """Pose of a camera turned left by `yaw`, down by `pitch` and about its axis by `roll`, in degrees."""
    pose = np.eye(4)
    pose[:3, :3] = (
        _rotation_about("z", yaw) @ _rotation_about("y", pitch) @ LOOKING_FORWARD @ _rotation_about("z", roll)
    )
    return pose


def _calibration(horizontal: float, vertical: float = 40.0) -> Calibration:
    """An undistorted camera with these fields of view in degrees, from outer edge to outer edge."""
    fx, fy = 320 / math.tan(math.radians(horizontal / 2)), 200 / math.tan(math.radians(vertical / 2))
    return Calibration(width=640, height=400, k=(fx, 0, 319.5, 0, fy, 199.5, 0, 0, 1))


def _camera(name: str, horizontal: float, vertical: float = 40.0, **turns: float) -> Camera:
    return Camera(name, _calibration(horizontal, vertical), _pose(**turns))


@pytest.mark.parametrize(
    ("first", "second", "yaw"), [(90, 90, 60), (52, 92, 57.3), (120, 60, -75), (90, 90, 89.5), (100, 100, 45)]
)
def test_the_overlap_of_level_cameras_is_what_their_fields_of_view_leave(first: float, second: float, yaw: float):
    # The second is the taller one, so that its upper and lower sides cut nothing away.
    cameras = _camera("a", first, 20.0), _camera("b", second, 60.0, yaw=yaw)
    assert overlap_angle(*cameras) == pytest.approx(first / 2 + second / 2 - abs(yaw), abs=1e-6)


def test_a_narrow_camera_inside_a_wide_ones_view_is_overlapped_whole():
    narrow, wide = _camera("narrow", 30, 20), _camera("wide", 120, 80, yaw=10)
    assert overlap_angle(narrow, wide) == pytest.approx(30.0)
    # In the wide one's picture the corners of the narrow one stick out a little.
    assert overlap_angle(wide, narrow) == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize(("yaw", "pitch"), [(91, 0), (180, 0), (135, 20), (0, 75)])
def test_cameras_that_look_past_each_other_do_not_overlap(yaw: float, pitch: float):
    assert overlap_angle(_camera("a", 90), _camera("b", 90, yaw=yaw, pitch=pitch)) == 0.0


def _overlap_by_sampling(camera: Camera, neighbour: Camera) -> float:
    """Width of the shared strip by asking for each of many rays whether the neighbour sees it."""
    K, size = camera.calibration.rectified_intrinsics, camera.calibration.image_size
    u, v = np.meshgrid(np.linspace(-0.5, size[0] - 0.5, 1601), np.linspace(-0.5, size[1] - 0.5, 1001))
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    neighbour_R_camera = neighbour.base_T_camera[:3, :3].T @ camera.base_T_camera[:3, :3]
    rays = np.tensordot(neighbour_R_camera, np.stack([x, y, np.ones_like(x)]), axes=1)
    K, size = neighbour.calibration.rectified_intrinsics, neighbour.calibration.image_size
    with np.errstate(divide="ignore"):
        u, v = K[0, 0] * rays[0] / rays[2] + K[0, 2], K[1, 1] * rays[1] / rays[2] + K[1, 2]
    seen = (rays[2] > 0) & (u > -0.5) & (u < size[0] - 0.5) & (v > -0.5) & (v < size[1] - 0.5)
    return float(np.ptp(np.degrees(np.arctan(x[seen])))) if seen.any() else 0.0


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"pitch": 15.0}, {"yaw": 60.0, "pitch": 15.0}),
        ({"pitch": -5.0}, {"yaw": -70.0, "pitch": 20.0}),
        ({"pitch": 40.0}, {"yaw": 90.0, "pitch": 40.0}),
        ({"roll": 8.0}, {"yaw": 75.0, "roll": -6.0}),
        ({}, {"yaw": 30.0, "pitch": 33.0}),
    ],
)
def test_the_overlap_of_pitched_and_rolled_cameras_is_that_of_their_rays(
    first: dict[str, float], second: dict[str, float]
):
    a, b = _camera("a", 90, 60, **first), _camera("b", 100, 50, **second)
    assert overlap_angle(a, b) > 5.0
    assert overlap_angle(a, b) == pytest.approx(_overlap_by_sampling(a, b), abs=0.15)
    assert overlap_angle(b, a) == pytest.approx(_overlap_by_sampling(b, a), abs=0.15)


def test_the_overlap_does_not_depend_on_a_camera_mounted_on_its_side():
    landscape = _camera("a", 60, 40), _camera("b", 60, 40, yaw=50)
    # Turned by 90 degrees, the field of view across the vehicle is the sensor's vertical one.
    portrait = _camera("a", 40, 60, roll=90), _camera("b", 40, 60, yaw=50, roll=-90)
    assert overlap_angle(*portrait) == pytest.approx(overlap_angle(*landscape))


def test_the_overlap_is_nearly_the_same_from_both_sides():
    a, b = _camera("a", 90, 50, pitch=10), _camera("b", 80, 60, yaw=55, pitch=5)
    assert overlap_angle(a, b) == pytest.approx(overlap_angle(b, a), abs=3.0)


def test_the_overlap_uses_the_rectified_view():
    P = (4 * 320.0, 0, 319.5, 0, 0, 4 * 320.0, 199.5, 0, 0, 0, 1, 0)
    zoomed = Camera("b", _calibration(90).model_copy(update={"p": P}), _pose())
    assert overlap_angle(_camera("a", 90, 60), zoomed) == pytest.approx(2 * math.degrees(math.atan(1 / 4)), abs=0.1)


def _rig(*cameras: Camera, **given: tuple[str, ...]) -> Rig:
    return Rig(cameras, "base_link", cameras[0].name, given)


def test_six_equal_cameras_around_a_vehicle_are_neighbours_in_a_ring():
    rig = _rig(*[_camera(f"c{i}", 70, yaw=60.0 * i) for i in range(6)])
    assert rig.neighbours == {f"c{i}": sorted([f"c{(i - 1) % 6}", f"c{(i + 1) % 6}"]) for i in range(6)}
    assert rig.neighbour_indices[:4] == [(0, 1), (0, 5), (1, 0), (1, 2)]
    assert [round(overlap.angle, 6) for overlap in rig.overlaps] == [10.0] * 12


@pytest.mark.parametrize(("gap", "are_neighbours"), [(-0.1, False), (0.1, True)])
def test_cameras_that_share_too_narrow_a_strip_are_no_neighbours(gap: float, are_neighbours: bool):
    rig = _rig(_camera("a", 90, 20), _camera("b", 90, 20, yaw=90 - MIN_NEIGHBOUR_OVERLAP_DEG - gap))
    assert len(rig.overlaps) == 2
    assert rig.neighbours == ({"a": ["b"], "b": ["a"]} if are_neighbours else {"a": [], "b": []})


def test_neighbours_are_mutual_where_only_one_of_two_sees_a_wide_strip():
    # Both look down, to different degrees: their corners meet, 1.2 degrees wide in one picture and 2.8 in the other.
    rig = _rig(_camera("a", 60, 60, pitch=37), _camera("b", 90, 60, yaw=94, pitch=25))
    angles = {overlap.camera: overlap.angle for overlap in rig.overlaps}
    assert min(angles.values()) < MIN_NEIGHBOUR_OVERLAP_DEG < max(angles.values())
    assert rig.neighbours == {"a": ["b"], "b": ["a"]}


def test_given_neighbours_have_precedence():
    rig = _rig(_camera("a", 90), _camera("b", 90, yaw=60), _camera("c", 90, yaw=-60), a=("c",), c=())
    assert rig.neighbours == {"a": ["c"], "b": ["a"], "c": []}


def test_cameras_are_ordered_to_the_left_around_the_vehicle_from_the_most_forward_one():
    yaws = {"r": -95, "b": 178, "fl": 55, "f": -3, "l": 110, "fr": -50}
    assert order_around_vehicle({name: _pose(yaw, pitch=10) for name, yaw in yaws.items()}) == [
        "f",
        "fl",
        "l",
        "b",
        "r",
        "fr",
    ]


@pytest.fixture(scope="module")
def sample() -> Rig:
    """The sample recording's rig: the shipped layout, its CameraInfo and its static transforms."""
    calibrations, base_T_frames, frames = {}, {}, {}
    with AnyReader([SAMPLE], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as recording:
        wanted = [c for c in recording.connections if c.topic == "/tf_static" or c.topic.endswith("/camera_info")]
        for connection, _, raw in recording.messages(wanted):
            message = recording.deserialize(raw, connection.msgtype)
            if connection.topic == "/tf_static":
                base_T_frames |= {t.child_frame_id: _pose_of(t.transform) for t in message.transforms}
            else:
                name = connection.topic.split("/")[2]
                frames[name] = message.header.frame_id
                calibrations[name] = Calibration(
                    width=message.width,
                    height=message.height,
                    k=tuple(message.k),
                    d=tuple(message.d),
                    p=tuple(message.p),
                )
    poses = {name: base_T_frames[frame] for name, frame in frames.items()}
    return load_rig_layout(ROOT / "config" / "rigs" / "pandaset.yaml").complete(calibrations, poses)


def _pose_of(transform: object) -> Pose:
    t, q = transform.translation, transform.rotation
    return pose_from_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))


@pytest.mark.parametrize(
    ("camera", "neighbour", "angle"),
    [("front", "front_left", 14), ("front", "front_right", 14), ("front_left", "left", 58), ("left", "back", 4)],
)
def test_the_samples_cameras_overlap_as_its_description_says(sample: Rig, camera: str, neighbour: str, angle: float):
    found = {(overlap.camera, overlap.neighbour): overlap.angle for overlap in sample.overlaps}
    assert found[camera, neighbour] == pytest.approx(angle, abs=1.5)
    assert found[neighbour, camera] == pytest.approx(angle, abs=1.5)


def test_the_samples_cameras_are_neighbours_around_the_vehicle_but_for_the_gap_behind(sample: Rig):
    # Back and right share one degree only: less than a neighbour needs.
    assert sample.neighbours == {
        "front": ["front_left", "front_right"],
        "front_left": ["front", "left"],
        "left": ["front_left", "back"],
        "back": ["left"],
        "right": ["front_right"],
        "front_right": ["front", "right"],
    }


def test_the_samples_cameras_come_in_order_around_the_vehicle(sample: Rig):
    assert order_around_vehicle({c.name: c.base_T_camera for c in reversed(sample.cameras)}) == PANDASET_CAMERAS


@pytest.mark.parametrize("dataset", sorted(METHOD_CAMERAS))
def test_the_shipped_layout_has_the_methods_order_and_neighbours(dataset: str):
    layout = load_rig_layout(ROOT / "config" / "rigs" / f"{dataset}.yaml")
    names = METHOD_CAMERAS[dataset]
    assert layout.names == names
    neighbours = {camera.name: list(camera.neighbours or ()) for camera in layout.cameras}
    assert neighbours == {names[i]: [names[j] for j in others] for i, others in METHOD_NEIGHBOURS.items()}
    assert layout.anchor_camera == names[0]


@pytest.mark.parametrize("path", RIG_FILES, ids=lambda path: path.stem)
def test_every_shipped_layout_completes_to_a_rig(path: Path):
    layout = load_rig_layout(path)
    topics = [topic for camera in layout.cameras for topic in (camera.image_topic, camera.camera_info_topic)]
    assert len(set(topics)) == len(topics)
    calibrations = dict.fromkeys(layout.names, _calibration(90))
    rig = layout.complete(calibrations, {name: _pose(yaw=60.0 * i) for i, name in enumerate(layout.names)})
    assert rig.names == layout.names
    assert len(rig.neighbour_indices) == 12


def test_the_shipped_layouts_are_those_of_the_three_datasets():
    assert [path.stem for path in RIG_FILES] == ["ddad", "nuscenes", "pandaset"]
    assert load_rig_layout(RIG_FILES[2]).names == PANDASET_CAMERAS
    assert [camera.neighbours for camera in load_rig_layout(RIG_FILES[2]).cameras] == [None] * 6
    assert all(camera.rectified for camera in load_rig_layout(RIG_FILES[1]).cameras)


def _entry(name: str, **fields: object) -> CameraEntry:
    return CameraEntry(name=name, image_topic=f"/{name}/image_raw", camera_info_topic=f"/{name}/camera_info", **fields)


def _full_layout(directory: Path) -> RigLayout:
    """A layout in which every field has a value of its own."""
    calibration = Calibration(
        width=1920,
        height=1080,
        distortion_model="rational_polynomial",
        d=tuple(0.1 / 3**i for i in range(8)),
        k=(1e3 / 3, 0, 960.1, 0, 1e3 / 7, 540.2, 0, 0, 1),
        p=(900.3, 0, 950.7, -1e-7, 0, 901.1, 530.9, 0, 0, 0, 1, 0),
        binning_x=2,
        binning_y=1,
        roi=RegionOfInterest(x_offset=10, y_offset=20, width=1800, height=1000),
    )
    pose = PoseEntry.from_matrix(_pose(yaw=33.3, pitch=7.7, roll=1e-5))
    front = _entry("front", calibration=calibration, base_T_camera=pose, mask=directory / "masks" / "front.png")
    rear = _entry("rear", frame_id="rear_optical", rectified=True, stamp_offset=-1e-5, neighbours=("front",))
    return RigLayout(base_frame="vehicle", anchor="rear", cameras=(front, rear))


def test_a_rig_file_gives_back_exactly_what_was_written(tmp_path: Path):
    layout = _full_layout(tmp_path)
    save_rig_layout(tmp_path / "rig.yaml", layout, "first line\nsecond line")
    assert load_rig_layout(tmp_path / "rig.yaml") == layout
    assert (tmp_path / "rig.yaml").read_text().startswith("# first line\n# second line\nbase_frame: vehicle\n")


def test_a_rig_file_saved_elsewhere_still_finds_its_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("rigs").mkdir()
    Path("copies").mkdir()
    layout = _full_layout(Path())
    save_rig_layout(Path("rigs/rig.yaml"), layout)
    save_rig_layout(Path("copies/rig.yaml"), load_rig_layout(Path("rigs/rig.yaml")))
    mask = load_rig_layout(Path("copies/rig.yaml")).cameras[0].mask
    assert mask is not None
    assert mask.resolve() == tmp_path / "masks" / "front.png"
    assert yaml.safe_load(Path("copies/rig.yaml").read_text())["cameras"][0]["mask"] == "../masks/front.png"


def _content(**changed: object) -> dict[str, object]:
    cameras = [{"name": n, "image_topic": f"/{n}/image", "camera_info_topic": f"/{n}/camera_info"} for n in ("a", "b")]
    cameras[1] |= changed
    return {"cameras": cameras}


K = [500.0, 0, 320, 0, 500, 240, 0, 0, 1]
LEVEL = [0.0, 0.0, 0.0, 1.0]
WRONG_FILES: dict[str, tuple[object, str]] = {
    "unknown field": (_content(colour="red"), r"cameras\.1\.colour: .*not permitted, found 'red'"),
    "unknown field of the rig": (_content() | {"speed": 3}, "speed: .*not permitted, found 3"),
    "wrong type": (_content(rectified="perhaps"), r"cameras\.1\.rectified: .*boolean.*found 'perhaps'"),
    "no topic": ({"cameras": [{"name": "a"}]}, r"cameras\.0\.image_topic: Field required"),
    "an offset that is no number": (_content(stamp_offset=math.nan), r"cameras\.1\.stamp_offset: .*finite.*nan"),
    "no cameras": ({"cameras": []}, "at least one camera, found none"),
    "the same name twice": (_content(name="a"), "two cameras are called a"),
    "a name that is no topic": (_content(name="rear left"), r"cameras\.1\.name: .*found 'rear left'"),
    "unknown neighbour": (_content(neighbours=["a", "c"]), "camera b: neighbours: no other camera is called c"),
    "itself as neighbour": (_content(neighbours=["b"]), "camera b: neighbours: no other camera is called b"),
    "a neighbour twice": (_content(neighbours=["a", "a"]), "camera b: neighbours: a, a names one twice"),
    "one image topic for two": (_content(image_topic="/a/image"), "image_topic: /a/image is that of a and b"),
    "unknown anchor": (_content() | {"anchor": "c"}, "anchor: no camera is called c; there are a, b"),
    "quaternion not unit": (
        _content(base_T_camera={"translation": [0, 0, 0], "rotation": [0, 0, 1, 1]}),
        r"cameras\.1\.base_T_camera: pose: quaternion .*0\.0, 0\.0, 1\.0, 1\.0.* norm 1\.414, not 1",
    ),
    "translation not finite": (
        _content(base_T_camera={"translation": [0, math.inf, 0], "rotation": LEVEL}),
        r"cameras\.1\.base_T_camera: pose: translation .*inf.*finite",
    ),
    "a Euler angle": (
        _content(base_T_camera={"translation": [0, 0, 0], "rotation": [0, 0, 90]}),
        r"cameras\.1\.base_T_camera\.rotation\.3: Field required",
    ),
    "uncalibrated": (
        _content(calibration={"width": 640, "height": 480, "k": [0.0] * 9}),
        r"cameras\.1\.calibration: K\[0\] = 0: the camera is not calibrated",
    ),
    "unknown distortion": (
        _content(calibration={"width": 640, "height": 480, "k": K, "distortion_model": "fov"}),
        r"cameras\.1\.calibration\.distortion_model: .*found 'fov'",
    ),
    "a list": ([1, 2], "valid dictionary"),
    "nothing": (None, "valid dictionary"),
}


@pytest.mark.parametrize(("content", "found"), WRONG_FILES.values(), ids=WRONG_FILES.keys())
def test_a_wrong_rig_file_is_refused_in_one_line_with_file_field_and_value(tmp_path: Path, content: object, found: str):
    path = tmp_path / "wrong.yaml"
    path.write_text("" if content is None else yaml.safe_dump(content))
    with pytest.raises(RigError, match=rf"^rig file .*wrong\.yaml: .*{found}") as error:
        load_rig_layout(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"cameras: [", b"\xff\xfe\x00", b"!!python/object:os.system {}", None])
def test_a_rig_file_that_cannot_be_read_is_named(tmp_path: Path, content: bytes | None):
    path = tmp_path / "rig.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RigError, match=r"^rig file .*rig\.yaml: cannot be read: ") as error:
        load_rig_layout(path)
    assert "\n" not in str(error.value)


def test_a_camera_without_calibration_is_named_with_its_topic():
    layout = RigLayout(cameras=(_entry("front"), _entry("rear")))
    with pytest.raises(RigError, match="camera rear: no calibration in the rig file nor on /rear/camera_info"):
        layout.complete({"front": _calibration(90)}, {"front": _pose()})


@pytest.mark.parametrize(("frame_id", "named"), [("rear_optical", "rear_optical"), (None, "its optical frame")])
def test_a_camera_without_transform_is_named_with_its_frame(frame_id: str | None, named: str):
    layout = RigLayout(base_frame="vehicle", cameras=(_entry("front"), _entry("rear", frame_id=frame_id)))
    calibrations = dict.fromkeys(layout.names, _calibration(90))
    with pytest.raises(TransformError, match=f"camera rear: no transform from {named} to vehicle"):
        layout.complete(calibrations, {"front": _pose()})


def test_a_transform_that_is_not_rigid_is_refused_by_name():
    layout = RigLayout(cameras=(_entry("front"), _entry("rear")))
    calibrations = dict.fromkeys(layout.names, _calibration(90))
    with pytest.raises(TransformError, match="camera rear: base_T_camera: not a rigid transform"):
        layout.complete(calibrations, {"front": _pose(), "rear": 2 * np.eye(4)})


def test_what_the_file_says_has_precedence_over_what_the_topics_say():
    pose = PoseEntry.from_matrix(_pose(yaw=90))
    front = _entry("front", calibration=_calibration(60), base_T_camera=pose, neighbours=())
    layout = RigLayout(cameras=(front, _entry("rear")))
    calibrations = dict.fromkeys(layout.names, _calibration(90))
    rig = layout.complete(calibrations, dict.fromkeys(layout.names, _pose()))
    assert [camera.calibration for camera in rig.cameras] == [_calibration(60), _calibration(90)]
    assert rig.cameras[0].base_T_camera == pytest.approx(_pose(yaw=90))
    assert rig.cameras[1].base_T_camera == pytest.approx(_pose())
    assert (rig.anchor, rig.base_frame, rig.neighbours["front"]) == ("front", "base_link", [])
