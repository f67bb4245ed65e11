# SPDX-License-Identifier: Apache-2.0
"""Pictures of worlds that are thought up: no black ones, nothing inside out, nothing that floats, no two alike."""

import numpy as np
import pytest
from simple_worlds import FORWARD, LENSES, Standing, daylight, short_drive, simple_world, street_spec, two_cameras

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.worlds.building import build_world
from cvcdepth_core.worlds.description import Building, Drive, Sky, WorldSpec
from cvcdepth_core.worlds.drive import DriveSpec, SimulatedDrive
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.random_world import random_world
from cvcdepth_core.worlds.rendering.camera_response import daylight_of, develop
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.renderer import Renderer
from cvcdepth_core.worlds.sensors import CameraLook, Sensors, random_look
from cvcdepth_core.worlds.shapes.meshes import box, cylinder, extruded, face_normals, prism, sphere
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.materials import FacadeParameters, Layer, Material, MaterialTable, Pattern, evaluate
from cvcdepth_core.worlds.surfaces.noise import Noise, noise

pytest.importorskip("embreex", reason="worlds need embreex")


@pytest.mark.parametrize("seed", range(8))
def test_pictures_of_random_worlds_show_something_and_their_truth_is_whole(seed: int):
    looks = (random_look(Dice(seed, 1)),)
    spec = DriveSpec(
        layout=two_cameras(), world=random_world(seed, None, 0.5), sensors=Sensors(looks=looks), seconds=0.2
    )
    drive = SimulatedDrive(spec)
    for camera in range(2):
        picture, truth = drive.shoot(camera, 0)
        assert picture.shape == (40, 64, 3)
        assert 45 < picture.mean() < 215
        assert picture.std() > 8
        assert not np.isnan(truth.depth).any()
        assert truth.depth.min() > 0.2
        assert (np.isinf(truth.depth) == (truth.objects == 0)).all()
        lengths = np.linalg.norm(truth.normals, axis=-1)
        assert lengths == pytest.approx(np.where(truth.objects == 0, 0.0, 1.0), abs=1e-5)


@pytest.mark.parametrize("weather", ["clear", "overcast", "dusk", "night"])
def test_the_same_street_is_exposed_well_in_every_weather(weather: str):
    elevation = {"dusk": 1.0, "night": -10.0}.get(weather, 30.0)
    world = street_spec(sky=Sky(weather=weather, sun_elevation=elevation, wet=0.5))
    picture = SimulatedDrive(short_drive().model_copy(update={"world": world})).shoot(0, 0).picture
    assert 60 < picture.mean() < 200
    assert (picture > 250).mean() < 0.4


@pytest.mark.parametrize("seed", [2, 9, 15])
def test_nothing_floats_over_the_ground(seed: int):
    spec = random_world(seed, None, 0.5)
    world, site = build_world(spec).world, Site(spec)
    corners = world.mesh.vertices[world.mesh.faces]
    lowest = corners[..., 2].min(axis=1)
    for number, name in enumerate(world.names):
        faces = np.flatnonzero(world.objects == number)
        if len(faces) and name not in ("wires", "road markings", "ground"):
            face = faces[lowest[faces].argmin()]
            place = corners[face, corners[face, :, 2].argmin()][None]
            ground = site.terrain.height(place[:, :2]) + site.raised(place[:, :2])
            assert lowest[face] - ground[0] < 0.2, name


def test_solids_are_not_inside_out():
    outline = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
    profile = [(-1.0, 0.0), (1.0, 0.0), (0.8, 1.0), (-0.8, 1.0)]
    solids = [
        box(1, 2, 3, 0),
        sphere(1.0, 0, 2),
        cylinder(0.5, 2.0, 0),
        extruded(profile, 1.5, 0),
        prism(outline, 0.0, 1.0, 0),
    ]
    for mesh in solids:
        middles = mesh.vertices[mesh.faces].mean(axis=1) - mesh.vertices.mean(axis=0)
        outward = (face_normals(mesh.vertices, mesh.faces) * middles).sum(axis=1)
        assert (outward > 0).all()


def test_colours_stay_within_what_surfaces_can_be():
    table = MaterialTable()
    numbers = [
        table.add(Material((0.9, 0.02, 0.5), (0.9, 0.9, 0.9), pattern, parameters=(0.5, 0.4, 0.02, 0.5)))
        for pattern in Pattern
        if pattern is not Pattern.FACADE
    ]
    for wall in range(5):
        parameters = tuple(FacadeParameters(style=wall % 4, ground_kind=wall % 4, wall=wall, lit=0.5))
        numbers.append(table.add(Material((0.9, 0.5, 0.1), (0.02, 0.02, 0.02), Pattern.FACADE, parameters=parameters)))
    rng = np.random.default_rng(0)
    materials = np.repeat(numbers, 3000)
    u, v = rng.uniform(-50, 50, (2, len(materials))).astype(np.float32)
    surface = evaluate(table.array(), materials, u, v, rng.uniform(0.001, 2.0, len(materials)).astype(np.float32))
    for values in surface:
        assert np.isfinite(values).all()
    assert 0.0 <= surface.colour.min() <= surface.colour.max() <= 0.95
    assert 0.0 <= surface.gloss.min() <= surface.gloss.max() <= 1.0
    assert surface.emission.min() >= 0.0


def test_noise_has_mean_0_and_deviation_1_and_fades_where_it_cannot_be_seen():
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-1000, 1000, (2, 40_000)).astype(np.float32)
    for kind in Noise:
        near, far = (noise(kind, u, v, np.full(len(u), footprint, np.float32)) for footprint in (1.0, 64.0))
        assert near.mean() == pytest.approx(0.0, abs=0.05)
        assert 0.6 < near.std() < 1.15  # what lies between two texels is a mean of them
        assert far.std() < near.std()
    repeated = noise(Noise.ROUGH, u + 256, v - 512, np.ones(len(u), np.float32))
    assert repeated == pytest.approx(noise(Noise.ROUGH, u, v, np.ones(len(u), np.float32)), abs=0.15)


def test_fixed_exposure_keeps_brightness_and_automatic_exposure_evens_it_out():
    light = np.full((8, 8, 3), 0.2, np.float32)
    auto, fixed = CameraLook(), CameraLook(exposure="fixed")
    shown = {look.exposure: [develop(light * f, look, 1.0, (0,)).mean() for f in (1.0, 0.25)] for look in (auto, fixed)}
    assert shown["auto"][0] == pytest.approx(shown["auto"][1], abs=1)
    assert shown["fixed"][0] > 1.5 * shown["fixed"][1]
    assert daylight_of(daylight()) == pytest.approx(0.8)


def test_lens_and_noise_do_what_they_are_told_and_the_same_every_time():
    light = np.full((40, 64, 3), 0.3, np.float32)
    plain = develop(light, CameraLook(), 1.0, (0, 1))
    dark = develop(light, CameraLook(vignetting=0.8), 1.0, (0, 1))
    assert dark[0, 0].mean() < 0.8 * plain[0, 0].mean()
    assert dark[20, 32].mean() == pytest.approx(plain[20, 32].mean(), abs=25)
    noisy = [develop(light, CameraLook(noise=0.05), 1.0, (0, seed)) for seed in (1, 1, 2)]
    assert noisy[0].std() > 3
    assert (noisy[0] == noisy[1]).all()
    assert (noisy[0] != noisy[2]).any()


def test_a_vehicle_that_starts_inside_a_wall_is_refused_by_name():
    wall = Building(at=(3.0, 0.0), road=None, size=(4.0, 6.0, 3.0))
    world = WorldSpec(buildings=(wall,), drive=Drive(at=(0.0, 0.0), road=None))
    spec = DriveSpec(layout=two_cameras(), world=world)
    with pytest.raises(ConfigError, match=r"the vehicle starts inside of something: building at x 0\.0, y 0\.0"):
        SimulatedDrive(spec)


def test_a_body_that_would_hide_a_low_camera_is_refused():
    low = two_cameras()
    mounts = [camera.base_T_camera for camera in low.complete().cameras]
    mounts[1][2, 3] = 0.4
    with pytest.raises(ConfigError, match=r"body car: a camera 0\.40 m above the ground would be inside of it"):
        build_world(street_spec(), "car", mounts)


@pytest.mark.parametrize("body", ["car", "van", "robot"])
def test_the_own_body_is_below_the_cameras_and_seen_by_them(body: str):
    low = two_cameras()
    spec = DriveSpec(layout=low, world=street_spec(), sensors=Sensors(body=body, seed=3), seconds=0.1)
    drive = SimulatedDrive(spec)
    shots = [drive.shoot(camera, 0).truth for camera in range(2)]
    assert all((truth.objects == 1).mean() < 0.6 for truth in shots)
    assert all(truth.depth.min() > 0.02 for truth in shots)
    assert any((truth.objects == 1).any() for truth in shots) or body == "robot"


def test_grain_that_is_far_below_a_pixel_is_not_seen():
    table = MaterialTable()
    grain = Material((0.3, 0.3, 0.3), coarse=Layer(Noise.GRAIN, 40.0, 0.3), fine=Layer(Noise.ROUGH, 90.0, 0.3))
    wall = box(0.1, 6000.0, 4000.0, table.add(grain), -2000.0).moved(300.0)
    mount = FORWARD.copy()
    mount[2, 3] = 20.0
    view = Renderer(simple_world([wall], table), Standing()).view(Lens("front", LENSES["no distortion"]), mount, 0.0)
    assert (view.truth.objects == 2).all()
    assert view.light.std() / view.light.mean() < 0.05
