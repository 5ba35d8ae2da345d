"""What is the hash-grid field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.fields import Budget
from edge_server.fields.ngp.field import NgpField
from tests.edge_server.fields.ngp.small import SMALL
from tests.edge_server.fields.small import SEEN, same_state, score


def test_a_smoothed_field_repeats_itself_and_is_smoother() -> None:
    small = replace(SMALL, base_resolution=8)  # coarse enough not to be hashed
    fields = [NgpField(replace(small, threads=n, smooth=s)) for n, s in ((1, 0.1), (3, 0.1), (2, 0.0))]
    for field in fields:
        field.fit(SEEN, Budget(steps=60))
    same_state(fields[0], fields[1])

    def rough(field: NgpField) -> float:
        side = int(field._grid.resolution[0]) + 1
        cube = field._grid.table[: side**3].reshape(side, side, side, 2)
        return float(np.mean([np.square(np.diff(cube, axis=axis)).mean() for axis in range(3)]))

    assert rough(fields[0]) < 0.7 * rough(fields[2])
    assert score(fields[0]) > 16.0
