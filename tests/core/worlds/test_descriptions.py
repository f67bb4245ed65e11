# SPDX-License-Identifier: Apache-2.0
"""Worlds and rigs that are thought up, and worlds as files."""

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from simple_worlds import street_spec, two_cameras

from cvcdepth_core.errors import ConfigError, RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.worlds.description import (
    Barrier,
    BarrierKind,
    Furniture,
    FurnitureKind,
    Person,
    PersonKind,
    Structure,
    StructureKind,
    Tree,
    TreeKind,
    Vehicle,
    VehicleKind,
    WorldSpec,
)
from cvcdepth_core.worlds.generation.kinds import WorldKind
from cvcdepth_core.worlds.generation.random_rig import random_rig
from cvcdepth_core.worlds.generation.random_world import random_world
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rig_size import complete_layout, layout_at_size
from cvcdepth_core.worlds.world_file import load_world, save_world


@pytest.mark.parametrize("kind", get_args(WorldKind))
def test_a_world_is_the_same_for_the_same_seed_and_survives_its_file(kind: WorldKind, tmp_path: Path):
    world = random_world(3, kind, 2.0)
    assert world == random_world(3, kind, 2.0)
    assert world != random_world(4, kind, 2.0)
    assert world.kind == kind
    save_world(tmp_path / "world.yaml", world, "Made by a test.")
    assert load_world(tmp_path / "world.yaml") == world


def test_any_kind_is_chosen_when_nobody_asks_for_one():
    assert len({random_world(seed, None, 0.5).kind for seed in range(14)}) > 3


def test_a_kind_that_does_not_exist_is_named_with_those_that_do():
    with pytest.raises(ConfigError, match="world kind moon: there is none; there are city, suburb, "):
        random_world(0, "moon", 1.0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("buildings: [{at: [0, 5], size: [10, 8]}]", "buildings.0.size"),
        ("statues: [{at: [0, 5]}]", "statues: Extra inputs are not permitted"),
        ("vehicles: [{at: [0, 5], kind: tank, road: null}]", "vehicles.0.kind: .*'tank'"),
        ("trees: [{at: [0, 5], road: 2}]", "trees.0.road: there is no road 2, only 0 in all"),
        ("roads: [{bends: [[50, 0.5]]}]", "roads.0: bends: curvature 0.5 is tighter than a radius of 5 m"),
        ("sky: {visibility: .nan}", "sky.visibility"),
        (
            "ground: {colour: [0.1, 0.2, 1.5]}",
            r"ground.colour: colour \(0.1, 0.2, 1.5\): want three numbers from 0 to 1",
        ),
        ("drive: {at: [0, 0], road: null, speeds: [[1, 2], [0, 3]]}", "drive.speeds: speeds: times"),
        ("a: [", "cannot be read"),
    ],
)
def test_what_is_wrong_in_a_world_file_is_named(text: str, message: str, tmp_path: Path):
    path = tmp_path / "world.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"world file .*world.yaml: {message}" if "read" not in message else message):
        load_world(path)


def test_everything_that_can_be_described_is_built_on_the_ground():
    pytest.importorskip("embreex", reason="bodies are fitted by rays")
    from cvcdepth_core.worlds.building import build_world

    parts = {
        "furniture": (Furniture(kind=kind, at=(0, 0), road=None, seed=1) for kind in get_args(FurnitureKind)),
        "vehicles": (Vehicle(kind=kind, at=(0, 0), road=None, seed=1) for kind in get_args(VehicleKind)),
        "people": (Person(kind=kind, at=(0, 0), road=None, seed=1) for kind in get_args(PersonKind)),
        "trees": (Tree(kind=kind, at=(0, 0), road=None, seed=1) for kind in get_args(TreeKind)),
        "barriers": (Barrier(kind=kind, line=((0, 0), (7, 1)), road=None) for kind in get_args(BarrierKind)),
        "structures": (Structure(kind=k, at=(0, 0), size=(30, 12, 5), road=None) for k in get_args(StructureKind)),
    }
    for name, each in parts.items():
        for part in each:
            world = build_world(WorldSpec(**{name: (part,)})).world
            mesh = world.mesh.vertices[world.mesh.faces[world.objects == world.objects.max()]]
            assert np.isfinite(mesh).all(), part
            assert -6.0 < mesh[..., 2].min() < 0.1, part
            assert mesh[..., 2].max() > 0.4, part


@pytest.mark.parametrize("seed", range(12))
def test_lenses_of_random_rigs_can_be_inverted_and_are_in_the_world(seed: int):
    layout = random_rig(seed)
    assert layout == random_rig(seed)
    small = layout_at_size(layout, (96, 64), 96)
    for camera in small.complete().cameras:
        Lens(camera.name, camera.calibration)
        assert camera.calibration.image_size == (96, 64)
        assert 0.4 < camera.base_T_camera[2, 3] < 2.7


def test_another_size_keeps_the_horizontal_view_and_square_pixels():
    layout = two_cameras(calibration=Calibration(width=1600, height=900, k=(1000, 0, 820, 0, 1010, 440, 0, 0, 1)))
    narrow = layout_at_size(layout, (320, 192), 480).cameras[0].calibration
    assert narrow is not None
    K = narrow.raw_intrinsics
    assert (K[0, 0], K[1, 1]) == pytest.approx((200.0, 202.0))
    assert K[0, 2] == pytest.approx((820.5) / 5 - 0.5)
    # 180 rows of the picture and 6 more above and below.
    assert K[1, 2] == pytest.approx(440.5 / 5 - 0.5 + 6)
    usual = layout_at_size(layout, None, 480).cameras[0].calibration
    assert usual is not None
    assert usual.image_size == (480, 270)


def test_a_rig_without_calibration_is_refused_by_camera():
    with pytest.raises(RigError, match="rig file x: camera front: no calibration; a rig needs both to be simulated"):
        complete_layout(two_cameras(calibration=None), "rig file x")
    with pytest.raises(RigError, match="camera front: no base_T_camera"):
        complete_layout(two_cameras(base_T_camera=None), "rig file x")


def test_the_street_of_the_tests_is_a_valid_world(tmp_path: Path):
    save_world(tmp_path / "street.yaml", street_spec())
    assert load_world(tmp_path / "street.yaml") == street_spec()
