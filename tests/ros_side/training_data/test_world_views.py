# SPDX-License-Identifier: Apache-2.0
"""Views of simulated drives as training samples: picture, depth and calibration belong together after every change."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from simple_worlds import LENSES, short_drive, two_cameras

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_core.rig.rig import Camera
from cvcdepth_core.training.config import TrainingConfig, WorldsConfig
from cvcdepth_core.training.distributed import Processes
from cvcdepth_core.worlds.shards import Shard, write_shard
from cvcdepth_ros.training_data.world_views import (
    ViewReader,
    WorldBatches,
    WorldRehearsal,
    WorldView,
    find_shards,
    told_wrongly,
    views_per_step,
)

pytest.importorskip("embreex", reason="worlds need embreex")

HEIGHT, WIDTH = 64, 96
CONFIG = TrainingConfig.model_validate(
    {
        "dataset": "worlds",
        "depth": {
            "encoder": "efficientnet_lite0",
            "height": HEIGHT,
            "width": WIDTH,
            "min_depth": 0.4,
            "max_depth": 250,
        },
        "optimizer": {"samples_per_step": 4, "samples_per_batch": 2},
        "worlds": {"held_out": 0.0},
    }
)
ALONE = Processes()
EXACT = WorldsConfig(angle_error=0.0, height_error=0.0)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for number, lens in enumerate(("plumb_bob", "equidistant")):
        changes = {"layout": two_cameras(calibration=LENSES[lens]), "seconds": 0.2}
        spec = short_drive().model_copy(update=changes)
        write_shard(folder / f"drive_{number:06d}.shard.zip", spec, "png")
    return folder


@pytest.fixture(scope="module")
def reader(shards: Path) -> ViewReader:
    return ViewReader(find_shards([shards]), HEIGHT, WIDTH)


def raw_pixels(view: WorldView, camera: Camera) -> np.ndarray:
    """Where the points that a view shows lie in the raw picture [H, W, 2], through pose and lens."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(view.intrinsics).T
    depth = np.where(np.isfinite(view.truth), view.truth, 1e4)[..., None]
    in_base = (rays * depth) @ view.base_T_camera[:3, :3].T + view.base_T_camera[:3, 3]
    camera_T_base = np.linalg.inv(camera.base_T_camera)
    points = (in_base @ camera_T_base[:3, :3].T + camera_T_base[:3, 3]).reshape(1, -1, 3)
    calibration, origin = camera.calibration, np.zeros(3)
    if calibration.distortion_model == "equidistant":
        found, _ = cv2.fisheye.projectPoints(points, origin, origin, calibration.raw_intrinsics, calibration.distortion)
    else:
        found, _ = cv2.projectPoints(points, origin, origin, calibration.raw_intrinsics, calibration.distortion)
    return found.reshape(HEIGHT, WIDTH, 2)


@pytest.mark.parametrize("shard", [0, 1], ids=["plumb_bob", "equidistant"])
@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_each_point_of_a_view_lies_where_the_raw_depth_has_it(shards: Path, reader: ViewReader, shard: int, seed):
    rng = None if seed is None else np.random.default_rng(seed)
    view = next(view for view in reader.views if view.shard == shard and view.camera == 1)
    found = reader.read(view, EXACT, rng)
    raw = Shard(find_shards([shards])[shard])
    camera = raw.layout.complete().cameras[1]
    depth, pixels = raw.sample(view.set, camera.name).depth, raw_pixels(found, camera)
    known = ~np.isnan(found.truth)
    same = np.zeros(known.sum(), bool)
    for shift in (-1e-3, 1e-3):  # either one, half way between two pixels
        nearest = np.round(pixels[known] + shift).astype(int)
        u, v = np.clip(nearest.T, 0, np.array([[depth.shape[1] - 1], [depth.shape[0] - 1]]))
        same |= depth[v, u] == found.truth[known]
    assert known.mean() > 0.6
    assert same.mean() > 0.98


def test_windows_differ_from_draw_to_draw_and_zoom_no_further_than_told(reader: ViewReader):
    whole = reader.read(reader.views[0], EXACT, None)
    drawn = [reader.read(reader.views[0], EXACT, np.random.default_rng(seed)) for seed in range(20)]
    zooms = np.array([view.intrinsics[0, 0] / whole.intrinsics[0, 0] for view in drawn])
    assert zooms.min() >= 1.0
    assert zooms.max() > 1.3
    assert len(set(zooms.tolist())) == 20
    assert np.array_equal(whole.base_T_camera, drawn[0].base_T_camera)


def test_what_the_network_is_told_of_a_mount_has_the_errors_of_a_rig_file():
    pose = np.eye(4)
    pose[2, 3] = 1.6
    rng = np.random.default_rng(0)
    told = [told_wrongly(pose, WorldsConfig(angle_error=0.5, height_error=0.04), rng) for _ in range(400)]
    angles = np.degrees([math.acos((np.trace(t[:3, :3]) - 1) / 2) for t in told])
    assert 0.5 < np.sqrt(np.mean(angles**2)) < 0.9  # half a degree about each of two axes
    assert np.std([math.log(t[2, 3] / 1.6) for t in told]) == pytest.approx(0.04, rel=0.15)


def test_an_epoch_shows_every_view_once_in_an_order_of_its_own_and_can_begin_anywhere(shards: Path):
    batches = WorldBatches(find_shards([shards]), CONFIG)
    first, second = (list(batches.epoch(number)) for number in (0, 1))
    assert batches.samples == 8 == sum(len(batch.frames) for batch in first)
    assert not torch.equal(first[0].frames, second[0].frames)
    later = list(batches.epoch(0, first=2))
    assert [b.truth.nan_to_num(-1.0).sum() for b in later] == [b.truth.nan_to_num(-1.0).sum() for b in first[2:]]
    assert {batch.truth.shape for batch in first} == {(2, 1, 1, HEIGHT, WIDTH)}


def test_several_processes_share_the_views_of_each_batch(shards: Path):
    alone = list(WorldBatches(find_shards([shards]), CONFIG.model_copy(update=TWICE)).epoch(0))
    halves = [list(WorldBatches(find_shards([shards]), CONFIG, Processes(rank, 2)).epoch(0)) for rank in (0, 1)]
    for whole, even, odd in zip(alone, *halves, strict=True):
        assert torch.equal(whole.frames[0::2], even.frames)
        assert torch.equal(whole.frames[1::2], odd.frames)


TWICE = {"optimizer": CONFIG.optimizer.model_copy(update={"samples_per_batch": 4})}


def rehearsal(reader: ViewReader, share: float = 0.5, processes: Processes = ALONE) -> WorldRehearsal:
    return WorldRehearsal(reader, with_share(share), 1.5, processes)


def with_share(share: float) -> TrainingConfig:
    worlds = CONFIG.worlds.model_copy(update={"share": share, "weight": 3.0})
    return CONFIG.model_copy(update={"worlds": worlds})


def frames_of(found: WorldRehearsal, step: int) -> torch.Tensor:
    return torch.cat([one.batch.frames for one in found.of_step(step)])


def test_beside_recordings_worlds_have_their_share_of_the_pictures(reader: ViewReader):
    assert [views_per_step(with_share(share), cameras=6) for share in (0.0, 0.01, 0.2, 0.5, 0.8)] == [0, 1, 6, 24, 96]
    found = rehearsal(reader)
    assert (found.views_per_step, found.weight) == (6, 2.0)
    assert [(one.first, len(one.batch.frames)) for one in found.of_step(1)] == [(0, 3), (3, 3)]


def test_rehearsal_shows_every_view_before_one_comes_again_and_a_step_is_always_the_same(reader: ViewReader):
    found, again = rehearsal(reader), rehearsal(reader)
    items = [found._drawn(place)[0] for place in range(24)]
    for turn in range(3):
        assert sorted(items[8 * turn : 8 * turn + 8]) == list(range(8))
    assert items[:8] != items[8:16]
    frames_of(found, 1)
    assert torch.equal(frames_of(found, 5), frames_of(again, 5))
    assert not torch.equal(frames_of(found, 5), frames_of(again, 6))


def test_several_processes_share_the_views_of_a_rehearsal(reader: ViewReader):
    alone = frames_of(rehearsal(reader, 0.2), 3)  # 2 views
    halves = [frames_of(rehearsal(reader, 0.2, Processes(rank, 2)), 3) for rank in (0, 1)]
    assert torch.equal(alone, torch.cat(halves))
    with pytest.raises(ConfigError, match=r"worlds.share is 0.2: that is 2 views in each step, fewer than the 3 proc"):
        rehearsal(reader, 0.2, Processes(0, 3))


def test_the_last_drives_are_held_out(shards: Path):
    config = CONFIG.model_copy(update={"worlds": WorldsConfig(held_out=0.5)})
    batches = WorldBatches(find_shards([shards]), config)
    assert (len(batches.reader.views), len(batches.held_out.views)) == (4, 4)
    with pytest.raises(ConfigError, match=r"worlds.held_out is 0.95: of 2 drives none is left"):
        WorldBatches(find_shards([shards]), CONFIG.model_copy(update={"worlds": WorldsConfig(held_out=0.95)}))


def test_a_folder_without_shards_and_a_damaged_shard_are_named(shards: Path, tmp_path: Path):
    with pytest.raises(RecordingError, match=rf"{tmp_path}: no shards \(\*.shard.zip\) there"):
        find_shards([tmp_path])
    (tmp_path / "cut.shard.zip").write_bytes(find_shards([shards])[0].read_bytes()[:500])
    with pytest.raises(RecordingError, match=r"cut\.shard\.zip: is no shard of a simulated drive"):
        WorldBatches(find_shards([tmp_path]), CONFIG)
