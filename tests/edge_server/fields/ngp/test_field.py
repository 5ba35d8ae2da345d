"""What is the hash-grid field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import Budget
from edge_server.fields.ngp.field import NgpField
from tests.edge_server.fields.ngp.small import SMALL
from tests.edge_server.fields.small import SEEN, same_state, score, small


@pytest.mark.parametrize("name", ["ngp", "nerfacto"])
def test_the_smoothing_applied_is_the_same_whatever_the_number_of_rays(name: str) -> None:
    """Adam multiplies gradients by a factor that falls with the rays of a step; smoothing must not fall."""
    field, applied = small(name, base_resolution=8, smooth=0.5), []
    field._encoding.table[:] = np.random.default_rng(0).normal(size=field._encoding.table.shape)
    field.step = 2  # of every four
    for scale in (0.5, 4.0):
        field._table_g[:], field._dirty[:] = 0.0, True  # and no sample has a gradient
        field._gather(1, scale)
        applied.append(scale * field._table_g[: field._encoding.first[1]])
    np.testing.assert_allclose(applied[0], applied[1], rtol=1e-5, atol=1e-5)
    side = int(field._encoding.resolution[0]) + 1
    cube = field._encoding.table[: side**3].reshape(side, side, side, 2).astype(np.float64)
    at, sides = cube[3, 3, 3], np.eye(3, dtype=int)
    around = cube[tuple((3 + np.concatenate([sides, -sides])).T)]
    # Every fourth step, four times the weight.
    np.testing.assert_allclose(
        applied[0][3 * (side * side + side + 1)], 4 * 0.5 * (6 * at - around.sum(axis=0)), rtol=1e-4
    )


def test_a_smoothed_field_repeats_itself_and_is_smoother() -> None:
    small = structs.replace(SMALL, base_resolution=8)  # coarse enough not to be hashed
    fields = [NgpField(structs.replace(small, threads=n, smooth=s)) for n, s in ((1, 0.1), (3, 0.1), (2, 0.0))]
    for field in fields:
        field.fit(SEEN, Budget(steps=60))
    same_state(fields[0], fields[1])

    def rough(field: NgpField) -> float:
        side = int(field._encoding.resolution[0]) + 1
        cube = field._encoding.table[: side**3].reshape(side, side, side, 2)
        return float(np.mean([np.square(np.diff(cube, axis=axis)).mean() for axis in range(3)]))

    assert rough(fields[0]) < 0.7 * rough(fields[2])
    assert score(fields[0]) > 16.0
