"""Numbers of all studies.

The sizes of a quick and a full pass stand in ``trial``, what one study sweeps in its file.
"""

from __future__ import annotations

LEAST_DB = 0.1
"""Smallest difference that supports a claim."""

STAGGER_MS = 217.0
"""Between the decision instants of successive seeds; not whole frames, so seeds sample all capture phases."""

SHOWN_INSTANTS = 3
"""Random instants at which a publication of a trial is scored, one in each equal part of the time it is shown."""

TRAININGS = {True: 1, False: 3}
"""Repeated trainings, by whether it is a quick pass; their spread is part of the interval."""
