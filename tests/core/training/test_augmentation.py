# SPDX-License-Identifier: Apache-2.0
"""Colour jitter, coins and windows: who shares a draw, what stays, what follows."""

import colorsys

import torch
from scenes import random_batch

from cvcdepth_core.training.augmentation import (
    ColorJitterConfig,
    adjust_brightness,
    adjust_contrast,
    adjust_hue,
    adjust_saturation,
    apply_changes,
    draw_flips,
    jitter_colors,
    zoom_in,
)
from cvcdepth_core.training.batch import RigBatch


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_frames_of_a_camera_share_one_draw_and_cameras_and_samples_do_not():
    frame = torch.rand(1, 1, 1, 3, 6, 8, generator=generator())
    jittered = jitter_colors(frame.expand(2, 3, 4, 3, 6, 8), ColorJitterConfig(), [generator(0), generator(1)])
    assert torch.equal(jittered[:, 0], jittered[:, 1])
    assert torch.equal(jittered[:, 0], jittered[:, 2])
    draws = jittered[:, 0].flatten(0, 1)
    assert all(not torch.equal(draws[i], draws[j]) for i in range(8) for j in range(i))
    assert 0 <= float(jittered.min()) <= float(jittered.max()) <= 1


def test_the_same_generator_gives_the_same_jitter():
    frames = torch.rand(1, 3, 2, 3, 6, 8)
    draws = [jitter_colors(frames, ColorJitterConfig(), [generator(seed)]) for seed in (5, 5, 6)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_no_jitter_changes_nothing():
    frames = torch.rand(1, 3, 2, 3, 6, 8)
    still = ColorJitterConfig(brightness=0, contrast=0, saturation=0, hue=0)
    torch.testing.assert_close(jitter_colors(frames, still, [generator()]), frames)


def test_each_change_does_what_its_name_says():
    image = 0.2 + 0.5 * torch.rand(3, 6, 8, generator=generator())
    grey = (image * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0)
    torch.testing.assert_close(adjust_brightness(image, 1.1), image * 1.1)
    torch.testing.assert_close(adjust_saturation(image, 0.0), grey.expand(3, 6, 8))
    torch.testing.assert_close(adjust_contrast(image, 0.0), grey.mean().expand(3, 6, 8))


def test_hue_turns_as_the_standard_library_does():
    image = torch.rand(3, 4, 5, generator=generator(), dtype=torch.float64)
    image[:, 0, 0] = 0.5  # grey has no hue
    for turns in (-0.4, -0.05, 0.0, 0.3):
        ours = adjust_hue(image, turns)
        for pixel, turned in zip(image.flatten(1).T.tolist(), ours.flatten(1).T, strict=True):
            hue, saturation, value = colorsys.rgb_to_hsv(*pixel)
            expected = colorsys.hsv_to_rgb((hue + turns) % 1.0, saturation, value)
            torch.testing.assert_close(turned, torch.tensor(expected, dtype=torch.float64))


def test_the_order_of_the_changes_counts():
    image = torch.rand(3, 6, 8, generator=generator())
    changes = [("brightness", 1.2), ("contrast", 0.8)]
    assert not torch.allclose(apply_changes(image, changes), apply_changes(image, changes[::-1]))


def test_the_coin_is_fair_and_tossed_per_sample():
    flips = draw_flips([generator(seed) for seed in range(4000)])
    assert flips.dtype == torch.bool
    assert 0.45 < float(flips.float().mean()) < 0.55


def slopes(batch: RigBatch) -> torch.Tensor:
    """Slopes x / z and y / z of the ray through each pixel, [B, N, 2, H, W]."""
    height, width = batch.frames.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.linalg.inv(batch.intrinsics)[..., None, None, :, :] @ torch.stack([u, v, torch.ones_like(u)], -1)[
        ..., None
    ].to(batch.intrinsics)
    return rays[..., :2, 0].movedim(-1, 2)


def test_a_window_shows_with_its_calibration_what_the_picture_showed_in_that_direction():
    batch = random_batch(2, 3, 32, 48)
    low, span = slopes(batch).amin(), slopes(batch).amax() - slopes(batch).amin()
    batch.frames[:, :, :, :2] = ((slopes(batch) - low) / span)[:, None]
    batch.truth = 1 + batch.frames[:, 0, :, :1]
    batch.truth[..., :4] = torch.nan
    zoomed = zoom_in(batch, 1.5, [generator(3), generator(4)])
    zooms = (zoomed.intrinsics / batch.intrinsics)[..., 0, 0]
    assert 1.0 <= float(zooms.min()) < float(zooms.max()) <= 1.5
    assert len(set(zooms.flatten().tolist())) == 6
    expected = ((slopes(zoomed) - low) / span)[:, None].expand(-1, 3, -1, -1, -1, -1)
    inner = (..., slice(1, -1), slice(1, -1))  # at the border of the picture there is nothing to interpolate with
    torch.testing.assert_close(zoomed.frames[:, :, :, :2][inner], expected[inner])
    known = torch.isfinite(zoomed.truth)
    assert float((zoomed.truth[known] - 1 - zoomed.frames[:, 0, :, :1][known]).abs().max()) < 0.6 / 32
    assert 0 < float(known.float().mean()) < 1
    zoomed.__post_init__()  # is a batch as any


def test_a_zoom_of_one_changes_nothing():
    batch = random_batch(1, 3, 32, 48)
    assert zoom_in(batch, 1.0, [generator()]) is batch
