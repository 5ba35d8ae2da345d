"""Settings: strict, with one clear line for everything that is wrong."""

from __future__ import annotations

from typing import Annotated, Literal

import pytest
from msgspec import field

from freshfield.settings import ScenarioError, Settings, as_mapping, describe, read_settings, within


class Inner(Settings, frozen=True):
    rate: float
    name: str = "x"


class Outer(Settings, frozen=True):
    count: int = 1
    on: bool = False
    share: float | None = None
    size: tuple[int, int] = (1, 1)
    inner: Inner | None = None
    level: Annotated[int, within(0, 10, "of noise")] = 3
    mode: Literal["mean", "max"] = "mean"
    tags: list[str] = field(default_factory=list)
    table: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError("count cannot be negative")


def test_a_mapping_becomes_a_struct():
    given = {"share": 1, "size": [3, 4], "inner": {"rate": 2}, "tags": ["a"], "table": {"k": 0.5}}
    assert read_settings(Outer, given, "s: x") == Outer(1, False, 1.0, (3, 4), Inner(2.0), 3, "mean", ["a"], {"k": 0.5})
    found = read_settings(Outer, given, "s: x")
    assert read_settings(Outer, as_mapping(found), "s: x") == found


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cuont": 1}, r"s: x\.cuont: unknown key; did you mean 'count'"),
        ({"count": 1.0}, r"s: x\.count: expected a whole number"),
        ({"on": 1}, r"s: x\.on: expected true or false"),
        ({"share": float("inf")}, r"s: x\.share: expected a number"),
        ({"size": [1, "b"]}, r"s: x\.size\[1\]: expected a whole number"),
        ({"inner": {}}, r"s: x\.inner\.rate: missing"),
        ({"level": 11}, r"s: x\.level: expected a whole number, 0 to 10, got 11"),
        ({"mode": "sum"}, r"s: x\.mode: expected one of mean, max, got 'sum'"),
        ({"tags": [7]}, r"s: x\.tags\[0\]: expected text, got 7: put it in quotes"),
        ({"count": -1}, r"s: x: count cannot be negative"),
        ([], "s: x: expected a mapping"),
    ],
)
def test_sections_refuse_by_name(given, message):
    with pytest.raises(ScenarioError, match=message):
        read_settings(Outer, given, "s: x")


def test_keys_are_described_with_default_bounds_and_help():
    lines = describe(Outer, leave_out=("inner",))
    assert "    level                  default 3; 0 to 10; of noise" in lines
    assert "    mode                   default 'mean'; one of mean, max" in lines
    assert not any("inner" in line for line in lines)
