"""What accuracy costs in time: the points of a frontier.json, and the one that is best at a speed."""

from __future__ import annotations

import json

import pytest
from msgspec.structs import replace

from edge_server.live.frontier import best_point, read_frontier
from edge_server.run_records import FrontierPoint

# Milliseconds an update, dB of the whole image and of what moves, meters a second.
POINTS = [
    FrontierPoint(100.0, 20.0, 18.0, 1.0),
    FrontierPoint(400.0, 21.0, 17.5, 1.0),
    FrontierPoint(400.0, 24.0, 17.0, 1.0),
    FrontierPoint(2000.0, 24.5, 14.0, 1.0),
    FrontierPoint(100.0, 19.0, 17.0, 4.0),
    FrontierPoint(400.0, 19.0, 13.0, 4.0),
]


def test_of_points_that_seeds_cannot_tell_apart_the_quickest_is_chosen():
    assert best_point(POINTS, 1.0) == POINTS[2], "longer updates show an older world"
    assert best_point(POINTS, 3.0) == POINTS[4], "the speed nearest in ratio"
    unsure = [replace(p, error_db=1.0) for p in POINTS]  # the best leads by 1.5, of which 1.4 may be chance
    assert best_point(unsure, 1.0) == unsure[2]
    unsure = [replace(p, error_db=1.2) for p in POINTS]
    assert best_point(unsure, 1.0) == unsure[0]
    assert best_point(unsure, 3.0) == unsure[4]


def test_points_are_read_and_errors_say_what_to_do(tmp_path):
    shipped = read_frontier(None, "ngp")
    assert len({p.update_ms for p in shipped}) >= 2 and all(p.update_ms > 0 for p in shipped)
    with pytest.raises(ValueError, match="edge-server frontier --field nothing"):
        read_frontier(None, "nothing")
    for text in ("", "[]", '{"updates": [{}]}', '{"updates": [], "updates": []}'):
        (tmp_path / "f.json").write_text(text)
        with pytest.raises(ValueError, match=r"f\.json: not a frontier"):
            read_frontier(tmp_path / "f.json", "ngp")
    row = {"field": "splat", "options": {}, "speed_m_per_s": 1.0, "update_s": 0.1, "psnr_db": 30.0}
    row |= {"psnr_moving_db": 20.0, "shown_psnr_db": 25.0, "shown_psnr_moving_db": 15.0}
    layers = row | {"options": {"layers": True}, "shown_psnr_db": 29.0}
    (tmp_path / "f.json").write_text(json.dumps({"updates": [row, layers]}))
    (plain,), (layered,) = (read_frontier(tmp_path / "f.json", "splat", layers=known) for known in (False, True))
    assert plain.psnr_db == 25.0 and plain.mean_db == 20.0, "by what was shown"
    assert layered.psnr_db == 29.0
