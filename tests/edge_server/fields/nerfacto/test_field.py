"""What is the proposal-sampled field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget
from edge_server.fields.nerfacto.field import NerfactoField
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.fields.small import HELD, SEEN, score
from tests.edge_server.fields.small_rays import SMALL


def test_samples_are_uniform_at_first_and_then_follow_the_proposal() -> None:
    field = NerfactoField(structs.replace(SMALL["nerfacto"], even=0.4, anneal=40))
    for step, share in ((0, 1.0), (10, 0.85), (40, 0.4), (400, 0.4)):
        field.step = step
        assert field._sampling().uniform_share == pytest.approx(share)
    assert NerfactoField(structs.replace(SMALL["nerfacto"], interlevel=0.0))._sampling().uniform_share == 1.0


def test_the_proposal_learns_where_surfaces_are() -> None:
    """Fewer samples do with it than without: that is what it is for. Without a depth guide, which would tell
    both where surfaces are."""
    scores = []
    for interlevel in (SMALL["nerfacto"].interlevel, 0.0):
        field = NerfactoField(structs.replace(SMALL["nerfacto"], interlevel=interlevel, depth_guide=0.0))
        field.fit(SEEN, Budget(steps=250))
        full = field.snapshot()
        sampling = full.encoding.sampling._replace(samples=4)
        few = replace(full, encoding=full.encoding._replace(sampling=sampling))
        color = few.render(HELD.camera_to_world, HELD.intrinsics).color
        scores.append(psnr(color, HELD.image / 255.0))
    assert scores[0] > scores[1] + 0.5


def test_appearances_take_up_what_differs_between_cameras() -> None:
    """A room's pictures with gains of 0.7 to 1.4; scored against the picture at the mean exposure."""
    still = synthetic_still("room", cameras=13, size=48)
    gains = np.exp(np.random.default_rng(2).permutation(np.linspace(-0.35, 0.35, 12)))
    views = [
        replace(v, image=np.clip(v.image * g + 0.5, 0, 255).astype(np.uint8)) for v, g in zip(still.training, gains)
    ]
    scores, looks = [], None
    for appearance in (0, 4):
        field = NerfactoField(structs.replace(SMALL["nerfacto"], appearance=appearance))
        field.fit(views, Budget(steps=300))
        scores.append(score(field, still.held_out[0]))
        looks = field._cameras.appearances
    assert scores[1] > scores[0] + 1.0
    assert looks is not None and set(looks.known) == {v.camera for v in views}
    values = np.array([known[0] for known in looks.known.values()])
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-9)
