"""The scenes of ``bench shown``: shipped ones, some that nothing was tuned on, and special cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from freshfield.scenario import Scenario, load, parse

FIRST_SEED = 7
DRAWN = (101, 102, 103)
# One thread, because the charged costs are those of one core.
_LAYERS = {
    "field": "splat",
    "field_options": {"layers": True, "threads": 1},
    "policy": {"name": "all"},
    "updates": "arrivals",
    "lpips": "none",
    "grace_ms": 1000.0,
}
_BEFORE = {**_LAYERS, "field_options": {"layers": False, "threads": 1}, "updates": "cycle"}
EDGES: dict[str, dict[str, Any]] = {"layers": _LAYERS, "before": _BEFORE}


@dataclass(frozen=True)
class Row:
    """One scene.

    base: a scenario, shipped or a file.
    changes: section -> keys that replace those of the base.
    seeds: number of seeds of variants that are repeated, from FIRST_SEED on.
    split: whether the effects of network and computing are separated.
    minutes: duration of a long run, which shows trends of age or fidelity; 0: a usual run.
    charged_as: name of the row whose costs are charged, which must be known; then only variant "shown" is
        measured.
    slower: factor of the charged costs, as of a processor with 1 / ``slower`` of the speed.
    """

    name: str
    base: str = "room"
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seeds: int = 1
    split: bool = True
    minutes: int = 0
    charged_as: str = ""
    slower: float = 1.0

    def scenario(self, seed: int, edge: str) -> Scenario:
        """The scene under one of ``EDGES``. Raises ScenarioError."""
        base = load(self.base, seed)
        cameras = {"ids": list(base.cameras), "held_out": list(base.held_out), "phase": base.phase}
        if "count" in (given := self.changes.get("cameras", {})):
            cameras.pop("ids")
        source = {**base.source, **self.changes.get("source", {})}
        return parse(
            {
                "name": self.name,
                "seed": seed,
                "cameras": {**cameras, **given},
                "source": source,
                "channel": dict(self.changes.get("channel", base.channel)),
                "edge": EDGES[edge],
            },
            base.path,
        )


def drawn(seed: int) -> Row:
    """A scene that nothing was tuned on: scene, walk, speed, number and field of view of the cameras, and
    network are drawn from the seed."""
    rng = np.random.default_rng([seed, 31])
    base = str(rng.choice(["room", "tower"]))
    source: dict[str, Any] = {
        "motion_seed": int(rng.integers(1000)),
        "speed_m_per_s": round(float(rng.uniform(0.5, 2.0)), 2),
        "horizontal_fov_deg": round(float(rng.uniform(-8, 8)) + (64 if base == "room" else 90), 1),
        "fps": float(rng.choice([10.0, 15.0, 20.0])),
    }
    count, preset = int(rng.integers(9, 18)), str(rng.choice(["ch5", "ch6", "ch6-high"]))
    cameras, channel = {"count": count, "phase": "spread"}, {"preset": preset}
    name = (
        f"drawn {seed}: {base}, {count - 1} cameras, {source['fps']:g} fps, {source['speed_m_per_s']:g} m/s, {preset}"
    )
    return Row(name, base, {"source": source, "cameras": cameras, "channel": channel})


def _case(name: str, **changes: Any) -> Row:
    return Row(f"room, {name}", "room", changes, split=False)


_HARD = (
    _case("stop and go", source={"params": {"course": "stops"}}),
    _case("reversals", source={"params": {"course": "reverses"}}),
    _case("teleports", source={"params": {"course": "jumps"}}),
    _case("two people", source={"params": {"people": 2}}),
)
ROWS: tuple[Row, ...] = (
    Row("room", seeds=5),
    Row("room19", "room19", {"cameras": {"phase": "spread"}}, seeds=3),
    Row("tower", "tower", seeds=3),
    Row("room, 3 m/s", "room", {"source": {"speed_m_per_s": 3.0}}, seeds=3),
    *map(drawn, DRAWN),
    *_HARD,
    _case("exposure drifts", source={"effects": {"exposure_drift": None}}),
    _case("a lamp goes out", source={"effects": {"light_switch": {"in_truth": True, "period_s": 4.8}}}),
    _case("noise", source={"effects": {"sensor_noise": {"read_noise_counts": 5.0}}}),
    _case("JPEG at 50", source={"quality": 50}),
    _case("6 cameras", cameras={"count": 7}),
    _case("4 cameras", cameras={"count": 5}),
    _case("1 camera", cameras={"count": 2}),
    _case("cameras locked", cameras={"phase": "locked"}),
    *(
        replace(row, name=f"{row.name}, {speed} the speed", charged_as=row.name, slower=slower)
        for speed, slower in (("half", 2.0), ("a quarter of", 4.0))
        for row in (Row("room", split=False), *_HARD)
    ),
    # Offered twice as many frames as it can take. Ages depend on the charged costs, so small images suffice.
    replace(
        _case("a quarter of the speed, ten minutes", source={"width": 32, "height": 32}),
        minutes=10,
        charged_as="room",
        slower=4.0,
    ),
)


def find(names: tuple[str, ...]) -> list[Row]:
    """The rows with these names; other names are scenarios of synthetic worlds, by name or file. Without
    names all ROWS."""
    known = {row.name: row for row in ROWS}
    return [known.get(name) or Row(name, name) for name in names] or list(ROWS)
