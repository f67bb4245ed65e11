# SPDX-License-Identifier: Apache-2.0
"""Where the cameras are, judged by their pictures alone; on real pictures see test_bag_check.py."""

import numpy as np
import pytest
import torch
from scenes import slanted_plane

from cvcdepth_core.rig_health.swapped_cameras import PlacedPictures, best_exchange


def placed(pictures: torch.Tensor, scene, first: int = 0) -> PlacedPictures:
    """Pictures [N, 3, H, W] of the scene's two cameras, the pose of camera `first` first."""
    images = (pictures.permute(0, 2, 3, 1)[None] * 255).to(torch.uint8).numpy()
    poses = scene.batch.base_T_camera[0].numpy()[[first, 1 - first]]
    return PlacedPictures(images, scene.batch.intrinsics[0].numpy(), np.ones(images.shape[1:4], bool), poses)


def test_exchanging_two_cameras_fits_worse_where_they_are_right_and_better_where_they_were_swapped():
    torch.manual_seed(0)
    scene = slanted_plane()
    right = best_exchange(placed(scene.batch.images[0], scene))
    swapped = best_exchange(placed(scene.batch.images[0], scene, first=1))
    assert right is not None
    assert swapped is not None
    assert right.ratio[0] > 1.15
    assert swapped.ratio[0] == pytest.approx(1 / right.ratio[0], rel=1e-5)


def test_pictures_that_have_nothing_in_common_favour_no_exchange():
    torch.manual_seed(0)
    scene = slanted_plane()
    found = best_exchange(placed(torch.rand_like(scene.batch.images[0]), scene))
    assert found is not None
    assert found.ratio[0] == pytest.approx(1, abs=0.1)


def test_cameras_that_see_nothing_of_each_other_cannot_be_judged():
    scene = slanted_plane()
    apart = placed(scene.batch.images[0], scene)
    apart.base_T_camera[1, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    apart.base_T_camera[0, :3, :3] = np.eye(3)
    assert best_exchange(apart) is None
