# SPDX-License-Identifier: Apache-2.0
"""Flow to another time or camera: each place is found again where the other truth has the same place."""

import numpy as np
import pytest
from simple_worlds import FORWARD, LENSES, Standing, simple_world, textured

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.worlds.rendering.flow import flow
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.renderer import Renderer
from cvcdepth_core.worlds.shapes.meshes import box, flat_mesh
from cvcdepth_core.worlds.surfaces.materials import MaterialTable
from cvcdepth_core.worlds.world import Mover

pytest.importorskip("embreex", reason="worlds need embreex")


@pytest.mark.parametrize("calibration", LENSES.values(), ids=LENSES)
def test_places_are_found_again_in_the_next_picture_also_on_what_moves(calibration: Calibration):
    table = MaterialTable()
    plain = textured(table)
    wall = flat_mesh([(40, -90, -50), (40, 90, -50), (40, 90, 60), (40, -90, 60)], [(0, 1, 2), (0, 2, 3)], plain)
    mover = Mover(3, box(1.0, 4.0, 4.0, plain, -1.0), Standing(speed=3.0, start=(9.0, 0.5, 0.0)))
    body = box(0.4, 0.6, 0.5, plain).moved(1.5)
    way = Standing(speed=6.0, yaw_rate=0.2)
    world = simple_world([wall], table, [mover])
    renderer, lens, mount = Renderer(world, way, body), Lens("front", calibration), FORWARD.copy()
    mount[:3, 3] = 0.3, 0.0, 1.0
    first, second = renderer.truth(lens, mount, 0.5), renderer.truth(lens, mount, 0.7)
    pixels = flow(world, way, first, (lens, mount, 0.5), (lens, mount, 0.7))
    assert np.isfinite(pixels).all()  # the wall closes the view
    rows, columns = np.mgrid[: lens.height, : lens.width]
    on_body = first.objects == 1
    assert on_body.any()
    assert pixels[on_body] == pytest.approx(np.stack([columns, rows], axis=-1)[on_body], abs=0.01)
    near = np.rint(pixels).astype(int)
    inside = (near >= 0).all(axis=-1) & (near[..., 0] < lens.width) & (near[..., 1] < lens.height)
    for number in (2, 3):
        own = inside & (first.objects == number)
        again = second.objects[near[own][:, 1], near[own][:, 0]]
        assert (again == number).mean() > 0.9
    # A place on the mover is 3 m/s away from where it was, and 6 m/s nearer to the camera.
    on_mover = inside & (first.objects == 3)
    depths = second.depth[near[on_mover][:, 1], near[on_mover][:, 0]]
    change = depths - first.depth[on_mover]
    assert np.median(change) == pytest.approx(-0.6, abs=0.15)


def test_the_sky_and_what_lies_behind_have_no_flow():
    table = MaterialTable()
    post = box(0.5, 0.5, 4.0, textured(table)).moved(8.0)
    way, lens, mount = Standing(), Lens("front", LENSES["no distortion"]), FORWARD.copy()
    mount[2, 3] = 1.5
    backward = mount.copy()
    backward[:2, :3] *= -1
    world = simple_world([post], table)
    truth = Renderer(world, way).truth(lens, mount, 0.0)
    pixels = flow(world, way, truth, (lens, mount, 0.0), (lens, mount, 0.0))
    assert (np.isnan(pixels[..., 0]) == np.isinf(truth.depth)).all()
    assert np.isnan(flow(world, way, truth, (lens, mount, 0.0), (lens, backward, 0.0))).all()
