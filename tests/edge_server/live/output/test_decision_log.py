"""Which decisions are kept for edge-server explain."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from edge_server.live.output.decision_log import DecisionLog
from edge_server.scheduler.learned import decision_record


def test_a_decision_is_written_with_the_update_that_it_was_taken_for(tmp_path, monkeypatch: pytest.MonkeyPatch):
    written = []
    writer = SimpleNamespace(write=written.append, lost=3)
    monkeypatch.setattr(decision_record, "DecisionWriter", lambda out, embedding: writer)
    log, decision = DecisionLog(tmp_path, None), SimpleNamespace(number=4)
    for policy, number in ((None, 3), (decision, 3), (decision, 4), (decision, 5)):
        log.record(SimpleNamespace(last_decision=policy), number)
    assert written == [decision] and log.lost == 3
    assert DecisionLog(tmp_path, None).lost == 0  # of a policy that learns nothing
