"""CSV files of times in ms: commas, decimal points, and a header that names the columns, in any order. What is written
otherwise (decimal commas, other units or separators) is refused, because it could be read in two ways."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from freshfield.untrusted import read_text

_FLAGS = {"": False, "0": False, "1": True}


class TableError(ValueError):
    """A table that cannot be read; the message is one line for people."""


class Row(dict[str, str]):
    """The fields of a line by column. line: its number, from 1."""

    def __init__(self, line: int, fields: dict[str, str]) -> None:
        super().__init__(fields)
        self.line = line

    def time_ms(self, column: str) -> float:
        """The number in a column; NaN where it is blank. Raises TableError."""
        word = self[column]
        try:
            value = float(word or "nan")
        except ValueError:
            value = math.inf
        if math.isinf(value) or (word and math.isnan(value)):
            raise TableError(f"line {self.line}: {column} is {word!r:.40}, expected a number with a decimal point")
        return value

    @property
    def lost(self) -> bool:
        """Whether the column ``lost`` says so, if there is one. Raises TableError."""
        word = self.get("lost", "")
        if word not in _FLAGS:
            raise TableError(f"line {self.line}: lost is {word!r:.40}, expected 0 or 1")
        return _FLAGS[word]


def read_table(path: Path, column: str = "") -> tuple[list[str], list[Row]]:
    """Names of the columns and rows of a file. Blank lines and those that begin with # are left out.

    column: name of the only column of a file without a header; "": there must be one.
    Raises TableError, OSError or UnicodeDecodeError.
    """
    numbered = [(k, line.strip()) for k, line in enumerate(read_text(path).removeprefix("\ufeff").splitlines(), 1)]
    lines = [(k, line) for k, line in numbered if line and not line.startswith("#")]
    try:
        rows = [(k, [word.strip() for word in next(csv.reader([line]))]) for k, line in lines]
    except csv.Error as error:
        raise TableError(f"cannot be read as CSV: {error}") from None
    names = [column]
    if rows and not _is_number(rows[0][1][0]):
        names = rows.pop(0)[1]
    for k, words in rows:
        if len(words) > len(names):
            raise TableError(
                f"line {k} has {len(words)} fields, expected {len(names)}: write decimal points, not commas"
            )
    return names, [Row(k, dict(zip(names, words + [""] * len(names)))) for k, words in rows]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
