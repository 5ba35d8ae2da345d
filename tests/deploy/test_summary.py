"""The summary of a run says what its report says."""

from __future__ import annotations

import json

import pytest

from freshfield_up.summary import summarize


@pytest.mark.parametrize(
    "closes, expected", [(True, "all accounted for"), (False, "the counts DO NOT ADD UP")]
)
def test_it_says_whether_all_frames_are_accounted_for(tmp_path, closes, expected):
    frames = {"captured": 3, "sent": 3, "delivered": 3, "rejected": {}, "closes": closes}
    (tmp_path / "report.json").write_text(json.dumps({"frames": frames}))
    assert expected in summarize(tmp_path)
