"""Tables of results in Markdown. CSV has ``freshfield.files``, figures have ``edge_server.matplotlib_figures``."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table.

    head: the names of the columns.
    rows: the cells of each row; None is an empty cell.
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join('' if c is None else str(c) for c in cells)} |" for cells in lines)


def number(value: float | None, digits: int = 2, sign: str = "") -> str:
    """Format a number with ``digits`` decimals; "-" if it is None or not finite. sign: "+" shows a plus."""
    return "-" if value is None or not math.isfinite(value) else f"{value:{sign}.{digits}f}"


def median_or_none(values: Iterable[float | None]) -> float | None:
    """The median of the values that are not None; None if there are none."""
    known = [v for v in values if v is not None]
    return float(statistics.median(known)) if known else None


def mean_or_none(values: Iterable[float | None]) -> float | None:
    """The mean of the values that are not None; None if there are none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def complete_mean(values: Sequence[float | None]) -> float | None:
    """The mean; None if a value is missing or there are none."""
    return None if None in values else mean_or_none(values)


def over_seeds(
    rows: Iterable[Mapping[str, Any]],
    keys: Sequence[str],
    names: Sequence[str],
    average: Callable[[Iterable[float | None]], float | None],
) -> list[dict[str, Any]]:
    """Merge the rows that agree in ``keys``: each result has these values, the number of rows as ``seeds``,
    and the ``average`` of each of ``names``."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [
        {**dict(zip(keys, values)), "seeds": len(of), **{n: average(row[n] for row in of) for n in names}}
        for values, of in groups.items()
    ]
