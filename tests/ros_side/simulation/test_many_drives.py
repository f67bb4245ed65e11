# SPDX-License-Identifier: Apache-2.0
"""Many short drives as shards: the same for any number of workers, and what is read is what was drawn."""

from pathlib import Path

import numpy as np
import pytest

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_core.worlds.drive import SimulatedDrive
from cvcdepth_core.worlds.shards import MOVING, OWN, SKY_LABEL, STATIC, Shard, labels, packed_depth, unpacked_depth
from cvcdepth_ros.simulation.many import ManyDrives, drive_spec, shard_path, simulate_many

pytest.importorskip("embreex", reason="worlds need embreex")

CHOICES = ManyDrives(
    drives=2, rig="random", world="rural", size=(48, 32), seed=4, seconds=0.2, rate=10.0, samples=1, look="varied",
    body="varied", stagger=None, readout=0.0, images="png", quality=90,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shards")
    simulate_many(CHOICES, path, workers=1)
    return path


def test_two_workers_write_the_same_shards_as_one(folder: Path, tmp_path: Path):
    simulate_many(CHOICES, tmp_path, workers=2)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["drive_000000.shard.zip", "drive_000001.shard.zip", "recipe.json"]
    assert all((tmp_path / name).read_bytes() == (folder / name).read_bytes() for name in names)


def test_what_is_read_is_what_was_drawn(folder: Path):
    shard, drive = Shard(shard_path(folder, 1)), SimulatedDrive(drive_spec(CHOICES, 1))
    assert shard.layout == drive.spec.layout
    assert (shard.sets, shard.kind) == (2, "rural")
    for index, camera in enumerate(drive.rig.cameras):
        shot, sample = drive.shoot(index, 1), shard.sample(1, camera.name)
        assert (sample.picture == shot.picture).all()
        assert (sample.labels == labels(shot)).all()
        known = np.isfinite(shot.truth.depth)
        assert sample.depth[known] == pytest.approx(shot.truth.depth[known], rel=1e-3)
        assert np.isinf(sample.depth[~known]).all()
        assert (shard.world_T_base[1, index] == drive.way.pose(drive.spec.camera_time(camera, 1))).all()
        assert shard.seconds[1, index] == drive.spec.camera_time(camera, 1)


def test_drives_differ_in_rig_world_and_camera():
    specs = [drive_spec(CHOICES, number) for number in range(6)]
    assert len({len(spec.layout.cameras) for spec in specs}) > 1
    assert len({spec.world.name for spec in specs}) == 6
    assert len({spec.sensors.looks[0] for spec in specs}) == 6
    assert len({spec.sensors.body for spec in specs}) > 1


def test_more_drives_are_added_and_other_choices_refused(folder: Path, tmp_path: Path):
    one = CHOICES._replace(drives=1)
    simulate_many(one, tmp_path, workers=1)
    before = shard_path(tmp_path, 0).stat().st_mtime_ns
    seen: list[int] = []
    simulate_many(CHOICES, tmp_path, workers=1, progress=seen.append)
    assert seen == [1, 2]
    assert shard_path(tmp_path, 0).stat().st_mtime_ns == before
    with pytest.raises(ConfigError, match="begun with another seed; choose another folder"):
        simulate_many(CHOICES._replace(seed=5), tmp_path, workers=1)


def test_labels_tell_sky_movers_and_the_own_vehicle_from_what_stands(folder: Path):
    found = set()
    for number in range(2):
        shard = Shard(shard_path(folder, number))
        for name in shard.layout.names:
            found |= set(np.unique(shard.sample(0, name).labels).tolist())
    assert {STATIC, SKY_LABEL} <= found <= {STATIC, SKY_LABEL, MOVING, OWN}


def test_depth_survives_packing():
    depth = np.random.default_rng(0).uniform(0.1, 500.0, (17, 23))
    depth[3, 4:9], depth[5, 5] = np.inf, 1e6
    again = unpacked_depth(packed_depth(depth), 17, 23)
    assert np.isinf(again[3, 4:9]).all()
    assert again[5, 5] == 65000 - 65000 % 32
    usual = np.isfinite(depth) & (depth < 1e5)
    assert again[usual] == pytest.approx(depth[usual], rel=1e-3)


def test_files_that_are_no_shards_are_named(folder: Path, tmp_path: Path):
    (tmp_path / "notes.shard.zip").write_text("nothing")
    with pytest.raises(RecordingError, match=r"notes.shard.zip: is no shard of a simulated drive"):
        Shard(tmp_path / "notes.shard.zip")
    with pytest.raises(RecordingError, match=r"drive_000000.shard.zip: 0009/nobody: cannot be read"):
        Shard(shard_path(folder, 0)).sample(9, "nobody")
