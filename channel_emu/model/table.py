"""Reads tables of times as loggers write them. The header names the columns, in any order, and their units
(``delay_ms``, ``Delay [s]``, ``latency (us)``). Ambiguous tables are refused."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from freshfield.untrusted import read_text

UNITS_MS = {"ns": 1e-6, "us": 1e-3, "µs": 1e-3, "μs": 1e-3, "ms": 1.0, "msec": 1.0, "s": 1e3, "sec": 1e3}
UNITS_MS |= {"nanoseconds": 1e-6, "microseconds": 1e-3, "milliseconds": 1.0, "seconds": 1e3}
_TITLE = re.compile(rf"(?P<name>.+?)(\s*[\[(](?P<in>.+?)[\])]|[\s_/]+(?P<unit>{'|'.join(UNITS_MS)}))?", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")  # or three decimals
_NOTHING = ("", "-", "na", "n/a", "nan", "none", "null", "inf", "lost", "timeout", "*")
_FLAGS = {"0": False, "false": False, "no": False, "": False, "1": True, "true": True, "yes": True}


class TableError(ValueError):
    """A table that is unreadable or ambiguous; the message is one line for people."""


@dataclass(frozen=True)
class Column:
    """A column of times. index: from 0. unit_ms: milliseconds of its unit."""

    title: str
    index: int
    unit_ms: float


@dataclass(frozen=True)
class Table:
    """titles: the header's, empty without one. rows: line number and fields, as many as the header has;
    those that a row lacks are empty."""

    titles: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]

    def column(self, *names: str) -> Column | None:
        """The column of times with the first of ``names`` that the table has. Raises TableError if it has no unit, or
        if two columns have that name."""
        for name in names:
            found = [(k, unit) for k, (title, unit) in enumerate(map(_title, self.titles)) if title == name]
            if not found:
                continue
            (index, unit), title = found[0], self.titles[found[0][0]]
            if len(found) > 1:
                raise TableError(
                    f"two columns are called {name}: {', '.join(self.titles[k] for k, _ in found)}: keep one"
                )
            if unit not in UNITS_MS:
                raise TableError(
                    f"the column {title!r} has no unit that is known: call it {name}_ms, {name}_s or {name}_us"
                )
            return Column(title, index, UNITS_MS[unit])
        return None

    def text(self, *names: str) -> int | None:
        """Index of the text column with one of ``names``."""
        return next((k for k, title in enumerate(self.titles) if _title(title)[0] in names), None)

    def lost(self) -> Iterator[bool]:
        """For each row, whether it is marked as lost."""
        index = self.text("lost", "loss", "dropped", "is_lost")
        for line, row in self.rows:
            word = "" if index is None else row[index].lower()
            if word not in _FLAGS:
                raise TableError(f"line {line}: {self.titles[index or 0]} is {word!r:.40}, expected 0 or 1")
            yield _FLAGS[word]

    def times_ms(self, column: Column) -> Iterator[float]:
        """The column's values in ms; NaN for blanks and, if there is a header, for words that mean a missing value."""
        for line, row in self.rows:
            word = row[column.index]
            if self.titles and word.lower() in _NOTHING:
                yield math.nan
                continue
            if not _NUMBER.fullmatch(word):
                raise TableError(f"line {line}: {column.title} is {word!r:.40}, expected a number")
            yield float(word.replace(",", ".")) * column.unit_ms


def read_table(text: str) -> Table:
    """The table in ``text``, separated by tabs, semicolons, commas or blanks. Lines that begin with # are comments; the
    last one before the numbers may be the header. Decimal commas are accepted if commas are not separators.

    Raises TableError.
    """
    numbered = [(k, line.strip()) for k, line in enumerate(text.splitlines(), 1)]
    lines = [(k, line) for k, line in numbered if line and not line.startswith("#")]
    if not lines:
        return Table((), ())
    separator = next((mark for mark in "\t;," if mark in lines[0][1]), None)
    if separator is None and len(lines[-1][1].split()) > 1:
        separator = " "
    rows = [(k, _fields(line, separator)) for k, line in lines]
    titles: tuple[str, ...] = ()
    comments = [line.lstrip("# ") for k, line in numbered if line.startswith("#") and k < lines[0][0]]
    if not _is_numbers(rows[0][1]):
        titles, rows = rows[0][1], rows[1:]
    elif comments and len(rows[0][1]) > 1 and len(named := _fields(comments[-1], separator)) == len(rows[0][1]):
        titles = named
    width = len(titles or rows[0][1])
    for k, row in rows:
        if len(row) > width:
            raise TableError(
                f"line {k} has {len(row)} fields, expected {width}: decimal commas need semicolons between"
            )
    words = [word for _, row in rows for word in row if _NUMBER.fullmatch(word)]
    commas = [word for word in words if "," in word]
    if commas and any("." in word for word in words):
        raise TableError("numbers are written with decimal points and with commas: use one of them")
    if commas and all(_THOUSANDS.fullmatch(word) for word in commas):
        raise TableError(f"{commas[0]} may be thousands or have three decimals: write decimal points, or no commas")
    return Table(titles, tuple((k, row + ("",) * (width - len(row))) for k, row in rows))


def read_delays(path: Path) -> list[float]:
    """One-way delays in ms from a file: one number a line, or a table with a header that names the delay and its unit,
    such as ``delay_ms``. Rows that a column ``lost`` marks, or without a delay, are left out.

    Raises TableError, which names the file.
    """
    try:
        table = read_table(read_text(path))
        column = table.column("delay", "latency", "one_way_delay", "owd")
        if column is None and table.titles:
            raise TableError(f"expected a column delay_ms (or delay_s, latency [us]); it has {', '.join(table.titles)}")
        if any(len(row) != 1 for _, row in table.rows) and column is None:
            raise TableError("expected one delay in ms a line, with a decimal point, or a header that names delay_ms")
        times = table.times_ms(column or Column("the delay", 0, 1.0))
        found = [time for time, lost in zip(times, table.lost()) if not lost and not math.isnan(time)]
        if not found:
            raise TableError("holds no delay")
        return found
    except TableError as error:
        raise TableError(f"{path}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise TableError(f"{path}: cannot be read: {error}") from None


def _fields(line: str, separator: str | None) -> tuple[str, ...]:
    if separator == " ":
        return tuple(line.split())
    try:
        return tuple(
            word.strip() for word in next(csv.reader([line], delimiter=separator or "\0", skipinitialspace=True))
        )
    except csv.Error as error:
        raise TableError(f"cannot be read as a table: {error}") from None


def _is_numbers(words: tuple[str, ...]) -> bool:
    return all(_NUMBER.fullmatch(word) for word in words)


def _title(title: str) -> tuple[str, str]:
    """A column's name, in lower case with underscores, and its unit, "" without."""
    found = _TITLE.fullmatch(title.strip())
    if found is None:
        return "", ""
    return re.sub(r"[\s_-]+", "_", found["name"].strip().lower()), (found["in"] or found["unit"] or "").strip().lower()
