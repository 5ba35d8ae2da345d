"""Every representation made small, and the views that tests fit it to.

A new one needs a line in ``SMALL`` and one in ``CLASSES``; ``test_every_representation`` asks all the same.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from edge_server.fields import View
from edge_server.fields.nerfacto.field import NerfactoField
from edge_server.fields.nerfacto.settings import NerfactoSettings
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings
from edge_server.fields.splat.field import SplatField
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.tensorf.field import TensorfField
from edge_server.fields.tensorf.settings import TensorfSettings
from edge_server.fields.voxel.field import VoxelField
from edge_server.fields.voxel.settings import VoxelSettings
from tests.edge_server.fields.scenes import picture, psnr, ring

NGP = NgpSettings(
    levels=6, log2_table=12, finest_resolution=64, hidden=16, rays=1024, batch_samples=8192, samples=96,
    cells=32, levels_every=15, samples_ramp=100, threads=2,
)  # fmt: skip
NERFACTO = NerfactoSettings(
    levels=6, log2_table=12, finest_resolution=64, hidden=16, rays=1024, batch_samples=8192, samples=12,
    samples_start=16, bins=48, cells=32, proposal_cells=32, anneal=60, threads=2,
)  # fmt: skip
TENSORF = TensorfSettings(
    color_rank=8, resolution_start=16, resolution=64, upsample=(20, 60, 120), hidden=16, rays=1024,
    batch_samples=8192, samples=96, samples_ramp=100, cells=32, threads=2,
)  # fmt: skip
SPLAT = SplatSettings(gaussians=1500, start=800, seed_cells=32, densify_every=20, threads=2)
VOXEL = VoxelSettings(sizes=(16, 32, 48), refine_at=(20, 60), rays=1024, cells=32, threads=2)

SMALL: dict[str, Any] = {"ngp": NGP, "nerfacto": NERFACTO, "tensorf": TENSORF, "splat": SPLAT, "voxel": VOXEL}
CLASSES: dict[str, Any] = {
    "ngp": NgpField, "nerfacto": NerfactoField, "tensorf": TensorfField, "splat": SplatField,
    "voxel": VoxelField,
}  # fmt: skip

VIEWS = ring(13)
HELD, SEEN = VIEWS[6], VIEWS[:6] + VIEWS[7:]
ASIDE_M = np.array([0.3, 0.0, 0.5])  # where the ball has gone in ``moved``


def small(name: str, **changed: Any) -> Any:
    """A field of that name, small, with other settings where ``changed`` says so."""
    return CLASSES[name](replace(SMALL[name], **changed))


def score(field: Any, view: View = HELD) -> float:
    """PSNR of a view, dB; that of the views' mean color is below 16."""
    return psnr(field.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0)


def moved(view: View) -> View:
    """The same camera's picture after the ball has gone aside."""
    return replace(view, image=picture(view.intrinsics, view.camera_to_world, ASIDE_M))


def cut_out(view: View) -> View:
    """The view with an alpha channel: its sky is transparent."""
    sky = (view.image == view.image[0, 0]).all(axis=-1)
    return replace(view, image=np.dstack([view.image, np.where(sky, 0, 255).astype(np.uint8)]))


def same_state(a: Any, b: Any) -> None:
    """Both hold the same numbers, bit for bit."""
    one, two = a.state(), b.state()
    assert one.keys() == two.keys()
    for name in one.keys() - {"meta"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
