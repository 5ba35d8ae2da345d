"""Records what a learned policy decided and saw, so that ``edge-server explain`` can explain it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from edge_server.scheduler import Policy
from freshfield.settings import as_mapping

if TYPE_CHECKING:  # imported at run time only where a policy is learned
    from edge_server.embed.settings import EmbeddingConfig
    from edge_server.scheduler.learned.decision_record import DecisionWriter


class DecisionLog:
    """Writes the decisions of learned policies under ``out``; with other policies it writes nothing.

    embedding: how frames are embedded, if they are. Not thread-safe.
    """

    def __init__(self, out: Path, embedding: EmbeddingConfig | None) -> None:
        self._out, self._embedding = out, embedding
        self._record: DecisionWriter | None = None

    def record(self, policy: Policy, number: int) -> None:
        """Write the decision of update ``number``, if ``policy`` is learned and took it."""
        decision = policy.last_decision
        if decision is None or decision.number != number:
            return
        if self._record is None:
            from edge_server.scheduler.learned.decision_record import DecisionWriter

            known = None if self._embedding is None else as_mapping(self._embedding)
            self._record = DecisionWriter(self._out, known)
        self._record.write(decision)

    @property
    def lost(self) -> int:
        """Number of decisions that could not be written."""
        return 0 if self._record is None else self._record.lost
