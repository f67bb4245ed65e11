# SPDX-License-Identifier: Apache-2.0
"""Colour jitter and mirroring: who shares a draw, what stays, what the coin decides."""

import colorsys

import torch

from cvcdepth_core.engines.example_rigs import ring_of_cameras
from cvcdepth_core.training.augmentation import (
    ColorJitterConfig,
    adjust_brightness,
    adjust_contrast,
    adjust_hue,
    adjust_saturation,
    apply_changes,
    draw_flips,
    jitter_colors,
    mirror,
    mirror_rig,
)


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


def test_mirroring_touches_only_the_samples_the_coin_names():
    images = torch.rand(3, 2, 3, 4, 5)
    mirrored = mirror(images, torch.tensor([True, False, True]))
    assert torch.equal(mirrored[0], images[0].flip(-1))
    assert torch.equal(mirrored[1], images[1])
    assert torch.equal(mirrored[2], images[2].flip(-1))


def test_the_mirrored_rig_sees_the_mirrored_world():
    """A point on one side is seen where its mirror image on the other side is seen in the mirrored picture."""
    rig = ring_of_cameras(64, 96).to(dtype=torch.float64)
    intrinsics = rig.intrinsics.clone()
    intrinsics[..., 0, 1], intrinsics[..., 0, 2] = 0.7, 30.0  # a skew, and a principal point aside
    rig = rig._replace(intrinsics=intrinsics)
    mirrored = mirror_rig(rig, torch.tensor([True]))
    points = 10 * torch.randn(200, 3, generator=generator(), dtype=torch.float64)
    other_side = points * points.new_tensor([1.0, -1.0, 1.0])
    for camera in range(6):
        pixels, depth = project(points, rig, camera)
        seen, seen_depth = project(other_side, mirrored, camera)
        torch.testing.assert_close(seen_depth, depth)
        torch.testing.assert_close(seen[:, 0], 95 - pixels[:, 0])
        torch.testing.assert_close(seen[:, 1], pixels[:, 1])


def project(points: torch.Tensor, rig, camera: int) -> tuple[torch.Tensor, torch.Tensor]:
    camera_T_base = torch.linalg.inv(rig.base_T_camera[0, camera])
    in_camera = points @ camera_T_base[:3, :3].T + camera_T_base[:3, 3]
    x, y, z = (in_camera @ rig.intrinsics[0, camera].T).T
    return torch.stack([x / z, y / z], dim=1), z


def test_the_mirrored_rig_could_be_built_and_mirrored_back_is_the_rig():
    rig = ring_of_cameras(64, 96).to(dtype=torch.float64)
    rig = rig._replace(masks=torch.rand(rig.masks.shape, generator=generator(), dtype=torch.float64))
    both = rig._replace(**{name: torch.cat([part, part]) for name, part in rig._asdict().items()})
    flips = torch.tensor([True, False])
    mirrored = mirror_rig(both, flips)
    torch.testing.assert_close(torch.linalg.det(mirrored.base_T_camera[..., :3, :3]), torch.ones(2, 6).double())
    assert torch.equal(mirrored.images[0], rig.images[0].flip(-1))
    assert torch.equal(mirrored.masks[0], rig.masks[0].flip(-1))
    for one, back, plain in zip(mirrored, mirror_rig(mirrored, flips), both, strict=True):
        assert torch.equal(one[1], plain[1])
        torch.testing.assert_close(back, plain)
