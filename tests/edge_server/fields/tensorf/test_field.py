"""What is the vector-matrix field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

from msgspec import structs

from edge_server.fields import Budget
from edge_server.fields.tensorf.field import TensorfField
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.fields.small import HELD, SEEN
from tests.edge_server.fields.tensorf.small import SMALL


def test_upsampling_hardly_changes_the_picture() -> None:
    field = TensorfField(structs.replace(SMALL, upsample=(60,)))
    field.fit(SEEN, Budget(steps=59))
    before, table = field.render(HELD.camera_to_world, HELD.intrinsics).color, field._encoding.table
    field.step = 60
    field._grow()
    field._snapshot = None
    after = field.render(HELD.camera_to_world, HELD.intrinsics).color
    assert field._encoding.size == 64 and len(field._encoding.table) > len(table)
    assert psnr(before, after) > 35.0
