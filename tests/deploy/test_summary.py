"""The summary of a run says what its report says."""

from __future__ import annotations

import json

import pytest

from freshfield_up.summary import summarize


@pytest.mark.parametrize(
    "found, expected",
    [
        ({"closes": True}, "; all accounted for\n"),
        ({"closes": True, "cut_off": 2}, "; all accounted for, 2 of them cut off by the end of a process\n"),
        (
            {"closes": False, "doubts": ["2,014 lines of the ledgers were lost", "another"]},
            "; NOT ALL ACCOUNTED FOR: 2,014 lines of the ledgers were lost; another\n",
        ),
    ],
)
def test_it_says_whether_all_frames_are_accounted_for(tmp_path, found, expected):
    frames = {"captured": 3, "sent": 3, "delivered": 3, "rejected": {}, **found}
    (tmp_path / "report.json").write_text(json.dumps({"frames": frames}))
    assert expected in summarize(tmp_path)
