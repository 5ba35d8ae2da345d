"""What is shown against a known world: how late it is, and what a perfect field would show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.experiments.virtual.shown_truth import GRID_NS, KnownWorld, ShownTruth
from edge_server.fields import Rendering
from edge_server.live.state import Publication
from freshfield.scenario import ScenarioError, parse

SOURCE = {"kind": "world", "scene": "room", "width": 64, "height": 64, "params": {"supersample": 1}}
HALF_A_STEP_MS = GRID_NS / 2e6
NOW = 400  # of the grid: 2 s


def scenario(**sections: Any):
    data = {"cameras": {"count": 3, "held_out": ["cam00"]}, "source": SOURCE, **sections}
    return parse(data, Path("known.yaml"))


@pytest.fixture(scope="module")
def world() -> KnownWorld:
    return KnownWorld(scenario())


class Delayed:
    """A field that shows the truth of some steps of the grid ago."""

    def __init__(self, world: KnownWorld, steps: int) -> None:
        self.world, self.steps, self.now = world, steps, NOW

    def render(self, *_: Any) -> Rendering:
        color = self.world.image(self.now - self.steps).astype(np.float32) / 255.0
        return Rendering(color, color[..., 0], color[..., 0])


def publication(published_ns: int, ages_ms: tuple[float, ...]) -> Publication:
    return Publication(
        0,
        published_ns / 1e9,
        published_ns,
        None,
        ("a", "b"),
        ages_ms,
        float(np.mean(ages_ms)),
        update_ms=20.0,
        network_ms=30.0,
    )


def looked_at(world: KnownWorld, field: Delayed, now: int = NOW) -> dict[str, Any]:
    """The instant of ``now``, 10 ms after a publication of views of 40 and 120 ms."""
    field.now = now
    truth = ShownTruth(world)
    truth.published(publication(now * GRID_NS - 10_000_000, (40.0, 120.0)))
    truth.score(field, now * GRID_NS)
    return truth.instants[0]


def test_a_perfect_field_has_no_lag_and_no_error(world: KnownWorld) -> None:
    found = looked_at(world, Delayed(world, 0))
    assert abs(found["lag_ms"]) < HALF_A_STEP_MS
    assert max(found["shown"].values()) < 1e-12


@pytest.mark.parametrize("now", [NOW, NOW + 37, NOW + 211])
def test_a_field_100_ms_late_reads_a_lag_of_100_ms(world: KnownWorld, now: int) -> None:
    found = looked_at(world, Delayed(world, 20), now)
    assert found["lag_ms"] == pytest.approx(100.0, abs=HALF_A_STEP_MS)
    assert found["shown"]["moving"] > 10 * found["shown"]["still"]


def test_the_ages_add_up(world: KnownWorld) -> None:
    ages = looked_at(world, Delayed(world, 0))["age_ms"]
    assert ages["display"] == 10.0 and ages["newest"] == 50.0 and ages["mean"] == 90.0
    split = ("network", "waiting", "computing", "display")
    assert sum(ages[name] for name in split) == pytest.approx(ages["mean"])


def test_a_perfect_field_knows_less_from_older_views_and_more_than_one_that_stands_still(world: KnownWorld) -> None:
    assert np.abs(world.carried(NOW * GRID_NS, NOW * GRID_NS).astype(int) - world.image(NOW)).max() <= 1
    for now in (NOW, NOW + 37, NOW + 211):
        late = looked_at(world, Delayed(world, 18), now)  # shows what it knew 90 ms ago
        assert 0.0 < late["newest"]["moving"] < late["mean"]["moving"] < 0.5 * late["shown"]["moving"]


def test_what_cannot_be_known_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"known\.yaml: expected a source of kind world and a held-out"):
        KnownWorld(scenario(cameras={"count": 3}))
