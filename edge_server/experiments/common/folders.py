"""Local folders for files that are not part of the repository."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Folders:
    """Local folders for files outside the repository; None: not given.

    data: recorded data sets.
    lpips: weights of LPIPS.
    """

    data: Path | None = None
    lpips: Path | None = None
