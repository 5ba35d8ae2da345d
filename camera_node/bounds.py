"""Dataclass fields that state the range or the choices of a setting, and the check of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any


def bounded(default: Any, lowest: float, highest: float) -> Any:
    """Field of a ``Bounded`` class: a number, or a tuple of numbers, from ``lowest`` to ``highest``
    inclusive. None is not checked."""
    return field(default=default, metadata={"range": (lowest, highest)})


def one_of(default: str, names: Sequence[str]) -> Any:
    """Field of a ``Bounded`` class: one of ``names``."""
    return field(default=default, metadata={"names": names})


@dataclass(frozen=True)
class Bounded:
    """Base of settings. Raises ValueError, in one line, for a value that its field does not allow, and for an
    empty tuple."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value, names = getattr(self, each.name), each.metadata.get("names")
            if names is not None and value not in names:
                raise ValueError(f"{each.name} is {value!r}, expected one of {', '.join(names)}")
            if value is None or "range" not in each.metadata:
                continue
            lowest, highest = each.metadata["range"]
            for number in value if isinstance(value, tuple) else (value,):
                if not lowest <= number <= highest:  # refuses NaN, too
                    # An integer of hundreds of digits fits no float.
                    shown = f"{number:.10g}" if isinstance(number, float) else f"{number!s:.60}"
                    raise ValueError(f"{each.name} is {shown}, expected {lowest:.10g} to {highest:.10g}")
            if value == ():
                raise ValueError(f"{each.name} is empty, expected one value or more")
