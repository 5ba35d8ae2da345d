"""The last lines of a run say what its report says."""

from __future__ import annotations

import json

import pytest

from freshfield_up.summary import summarise


@pytest.mark.parametrize("closes, said", [(True, "the books close"), (False, "the books DO NOT CLOSE")])
def test_the_reports_own_verdict_on_the_books_is_shown(tmp_path, closes, said):
    frames = {"captured": 3, "sent": 3, "delivered": 3, "rejected": {}, "closes": closes}
    (tmp_path / "report.json").write_text(json.dumps({"frames": frames}))
    assert said in summarise(tmp_path)
