"""Keeps what a learnt policy decided and saw, so that it can be explained (``edge-server explain``)."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from edge_server.scheduler import Policy

if TYPE_CHECKING:  # loaded only where a policy was learnt
    from edge_server.embed import EmbeddingConfig
    from edge_server.scheduler.learned.decision_record import DecisionWriter


class Decisions:
    """Writes decisions under ``out``, live and in virtual time; of policies that were not learnt there are
    none, and nothing is written. embedding: how frames are embedded, if they are. Not thread-safe."""

    def __init__(self, out: Path, embedding: EmbeddingConfig | None) -> None:
        self._out, self._embedding = out, embedding
        self._record: DecisionWriter | None = None

    def keep(self, policy: Policy, number: int) -> None:
        """Keep the decision of update ``number``, where ``policy`` took it as it has learnt to."""
        decided = policy.last_decision
        if decided is None or decided.number != number:
            return
        if self._record is None:
            from edge_server.scheduler.learned.decision_record import DecisionWriter

            known = None if self._embedding is None else dataclasses.asdict(self._embedding)
            self._record = DecisionWriter(self._out, known)
        self._record.write(decided)

    @property
    def lost(self) -> int:
        """Decisions that could not be written."""
        return 0 if self._record is None else self._record.lost
