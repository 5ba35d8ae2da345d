"""What is the vector-matrix field's own; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace

import pytest

from edge_server.fields import Budget
from edge_server.fields.registry import make_field
from edge_server.fields.tensorf.field import TensorfField
from edge_server.fields.tensorf.settings import EFFORTS, help_text, make_settings
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.fields.small import HELD, SEEN
from tests.edge_server.fields.tensorf.small import SMALL


def test_upsampling_hardly_changes_the_picture() -> None:
    field = TensorfField(replace(SMALL, upsample=(60,)))
    field.fit(SEEN, Budget(steps=59))
    before, table = field.render(HELD.camera_to_world, HELD.intrinsics).color, field._encoding.table
    field.step = 60
    field._grow()
    field._snapshot = None
    after = field.render(HELD.camera_to_world, HELD.intrinsics).color
    assert field._encoding.size == 64 and len(field._encoding.table) > len(table)
    assert psnr(before, after) > 35.0


def test_a_state_of_another_shape_is_refused() -> None:
    state = TensorfField(SMALL).state()
    with pytest.raises(ValueError, match="density_rank = 8"):
        TensorfField(replace(SMALL, density_rank=16)).load_state(state)
    with pytest.raises(ValueError, match="not a state"):
        TensorfField(SMALL).load_state({"table": state["table"]})


def test_it_is_registered_and_its_options_are_checked() -> None:
    field = make_field("tensorf", {"density_rank": 16, "upsample": [10, 20]}, seed=5)
    assert isinstance(field, TensorfField) and field.settings.upsample == (10, 20)
    with pytest.raises(ValueError, match=r"no option levels; it has: effort, density_rank, .*nice"):
        make_field("tensorf", {"levels": 3})
    for wrong, text in (
        ({"density_rank": 4}, "density_rank must be in 8..64, not 4"),
        ({"color_rank": 12}, "multiple of 8"),
        ({"upsample": [20, 10]}, "rising"),
        ({"resolution": 2}, "resolution must be in 4..1024"),
        ({"device": "cuda"}, "CPUs only"),
        ({"effort": "heroic"}, "low, medium, high"),
    ):
        with pytest.raises(ValueError, match=text):
            make_field("tensorf", wrong)
    assert all(len(text) > 10 for text in help_text().values())
    assert make_settings({"effort": "low"}).color_rank == EFFORTS["low"]["color_rank"]
