"""What is the hash-grid field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.fields import Budget
from edge_server.fields.ngp.field import NgpField
from tests.edge_server.fields.ngp.small import SMALL
from tests.edge_server.fields.small import HELD, SEEN, same_state, score


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


def test_fewer_samples_render_a_rougher_picture() -> None:
    field = NgpField(SMALL)
    field.fit(SEEN, Budget(steps=100))
    snapshot = field.snapshot()
    full = snapshot.render(HELD.camera_to_world, HELD.intrinsics)
    rough = snapshot.render(HELD.camera_to_world, HELD.intrinsics, max_samples=2)
    assert rough.opacity.mean() <= full.opacity.mean() + 1e-6
    assert not np.array_equal(full.color, rough.color)
