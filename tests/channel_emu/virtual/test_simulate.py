from __future__ import annotations

import pytest

from channel_emu.model.channel import Channel
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import OUTCOMES, LinkRun, SimulationError, offer_all, simulate


def decisions(run: LinkRun) -> list[tuple]:
    return [(t.offered_ns, t.outcome, t.started_ns, t.due_ns) for t in run.transits]


def same(a: LinkRun, b: LinkRun) -> bool:
    """Whether every decision is alike."""
    return decisions(a) == decisions(b)


@pytest.mark.parametrize("preset", ["ch5", "ch6"])
def test_adding_and_renaming_cameras_changes_nothing_for_the_others(preset: str) -> None:
    config = channel_from_mapping({"preset": preset})
    few = simulate(config, ["b", "d"], 20, 3).runs
    many = simulate(config, ["a", "b", "c", "d"], 20, 3).runs
    assert same(few[0], many[1]) and same(few[1], many[3])
    assert not same(many[0], many[1])
    assert not same(few[0], simulate(config, ["b", "d"], 20, 4).runs[0])


def test_counts_close() -> None:
    chance = {"probability": 0.1}
    faults = {"loss": chance, "duplication": chance, "reset": {"mean_interval_ms": 500}}
    result = simulate(channel_from_mapping({"preset": "ch6", "faults": faults}), 3, 30).summary()
    assert result["offered"] == result["in_flight"] + sum(result[name] for name in OUTCOMES)
    assert result["dropped"] == sum(result[name] for name in OUTCOMES[1:])
    assert min(result[k] for k in ("lost", "broken", "superseded", "delivered", "duplicated")) > 0


def test_known_figures_of_the_presets() -> None:
    """Measured independently: ch6 with a frame every 30 ms under drop-new ages 94.5 ms."""
    config = channel_from_mapping({"preset": "ch6", "arrivals": "periodic:30ms", "discipline": "drop-new"})
    assert simulate(config, 6, 600, 1).summary()["mean_age_ms"] == pytest.approx(94.5, rel=0.01)


def test_replayed_offers_are_decided_as_in_the_simulation() -> None:
    config = channel_from_mapping({"preset": "ch6", "faults": {"loss": {"probability": 0.2}}})
    run = simulate(config, ["x"], 30, 9, frame_period_ms=33.3).runs[0]
    offers = {"x": [(t.offered_ns, 20_000) for t in run.transits]}
    links, transits = offer_all(Channel(config, 9), offers, run.end_ns)
    assert same(LinkRun(links["x"], transits["x"], run.end_ns), run)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"cameras": 0}, "cameras"),
        ({"cameras": 10_001}, "cameras"),
        ({"seconds": 0}, "seconds"),
        ({"frame_period_ms": float("nan")}, "frame_period_ms"),
        ({"frame_bytes": -1}, "frame_bytes"),
        ({"seconds": 1e7}, "frames"),
    ],
)
def test_impossible_requests_are_refused(more: dict, why: str) -> None:
    with pytest.raises(SimulationError, match=why):
        simulate(channel_from_mapping({}), **{"cameras": 1, "seconds": 1, **more})
