"""What is the voxel field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.voxel.field import VoxelField
from tests.edge_server.fields.scenes import mean_psnr, psnr
from tests.edge_server.fields.small import HELD, SEEN, same_state
from tests.edge_server.fields.voxel.small import SMALL


@pytest.mark.slow
def test_a_long_fit_is_no_worse_than_a_short_one() -> None:
    few, others = SEEN[::2], SEEN[1::2]  # few views are soon known by heart
    gains = []
    for settle in (SMALL.settle, 0.0):
        short, long = (VoxelField(replace(SMALL, settle=settle, diffuse=0.0)) for _ in range(2))
        short.fit(few, Budget(steps=150))
        long.fit(few, Budget(steps=1200))
        gains.append(mean_psnr(long, others) - mean_psnr(short, others))
    assert gains[0] > -0.25 and gains[1] < -0.5


@pytest.mark.slow  # 6 s
def test_a_diffused_grid_repeats_itself_and_shows_better_what_it_has_not_seen() -> None:
    few, others = SEEN[::2], SEEN[1::2]
    fields = [VoxelField(replace(SMALL, threads=n, diffuse=s)) for n, s in ((1, 1.0), (3, 1.0), (2, 0.0))]
    for field in fields:
        field.fit(few, Budget(steps=400))
    same_state(fields[0], fields[1])
    assert mean_psnr(fields[0], others) > mean_psnr(fields[2], others) + 0.3


def test_diffusion_counts_the_less_the_more_places_were_seen_from() -> None:
    def fitted(views: list[View], **changed: Any) -> VoxelField:
        field = VoxelField(replace(SMALL, **changed))
        field.fit(views, Budget(steps=40))
        return field

    same_state(fitted(SEEN, diffuse_views=len(SEEN) // 2), fitted(SEEN, diffuse=0.5))
    twice = [*SEEN, *(replace(view, camera=f"{view.camera}, beside itself") for view in SEEN)]
    assert len(twice) == 24 and len({tuple(view.camera_to_world[:3, 3]) for view in twice}) == 12
    same_state(fitted(twice, diffuse_views=12), fitted(twice, diffuse_views=1000))
    with pytest.raises(AssertionError):
        same_state(fitted(SEEN, diffuse_views=11), fitted(SEEN))


def test_upsampling_hardly_changes_the_picture() -> None:
    field = VoxelField(replace(SMALL, sizes=(32, 48), refine_at=(60,)))
    field.fit(SEEN, Budget(steps=60))
    before, table = field.render(HELD.camera_to_world, HELD.intrinsics).color, field._voxels.table
    field._grow(60)
    field._snapshot = None
    after = field.render(HELD.camera_to_world, HELD.intrinsics).color
    assert field._voxels.size == 48 and len(field._voxels.table) > len(table)
    assert psnr(before, after) > 26.0


def test_the_grid_is_as_fine_as_pixels_where_no_size_is_set() -> None:
    field = VoxelField(replace(SMALL, sizes=None, refine_at=(3, 6)))
    field.fit(SEEN, Budget(steps=8))
    assert field.view_store.box is not None
    last = np.clip(field.view_store.box.pixels_across, 64, 192)
    assert 0 <= field._voxels.size - last < 32 and field._sizes[0] < field._sizes[1] < field._sizes[2]
    other = VoxelField(field.settings)
    other.load_state(field.state())
    same_state(field, other)


def test_a_plain_background_is_known_to_be_empty_in_spite_of_noise() -> None:
    rng = np.random.default_rng(0)
    noise = [np.rint(rng.normal(0.0, 1.5, v.image.shape)) for v in SEEN]
    noisy = [replace(v, image=np.clip(v.image + n, 0, 255).astype(np.uint8)) for v, n in zip(SEEN, noise)]
    field = VoxelField(SMALL)
    field.fit(noisy, Budget(steps=2))
    assert field._outline_views is not None
    alpha = field._outline_views[1].pixels[:, 3]
    sky = np.concatenate([(v.image == v.image[0, 0]).all(axis=-1).ravel() for v in SEEN])
    assert alpha[sky].mean() < 1.0 and alpha[~sky].mean() > 250.0
    without = VoxelField(replace(SMALL, outline=0.0))
    without.fit(noisy, Budget(steps=2))
    assert without._outline_views is not None and without._outline_views[1].pixels.shape[1] == 3
