"""A picture that is good for nothing is told, with its likely cause."""

from __future__ import annotations

from dataclasses import replace

import pytest

from edge_server.fidelity.scorer import SELECTED
from edge_server.live.state import CameraView
from edge_server.page.diagnosis import poor_picture
from edge_server.page.settings import FLAT_SCORES
from tests.edge_server.page.test_page import publication

GOOD = CameraView("cam01", False, None, 80.0, 100, 3)
CASES = {
    "poses or lenses": [GOOD, replace(GOOD, camera="cam02"), replace(GOOD, camera="cam00", held_out=True)],
    "frames are 9 s old; see the network": [replace(GOOD, age_ms=9000.0), replace(GOOD, age_ms=9100.0)],
    "refuses frames of cam01;": [replace(GOOD, rejected=100), GOOD],
    "1 of 2 cameras have sent": [GOOD, replace(GOOD, age_ms=None)],
    "0 of 2 cameras have sent": [replace(GOOD, age_ms=None)] * 2,
}


def scored(*psnr_db):
    return [replace(publication(number), psnr_db=db) for number, db in enumerate(psnr_db)]


@pytest.mark.parametrize("cause", CASES)
def test_the_likely_cause_is_named(cause):
    said = poor_picture(12.0, scored(*[30.0] * 9, *[12.3, None] * FLAT_SCORES), CASES[cause])
    assert "no better than one mean color (12.3 dB; that color 12.0 dB)" in said and cause in said


def test_views_that_were_learned_from_are_not_blurred_by_cameras_that_share_little():
    for scored_on, cause in (("cam00", "different places"), (SELECTED, "too short a run")):
        publications = [replace(each, scored_on=scored_on) for each in scored(*[12.3] * FLAT_SCORES)]
        assert cause in poor_picture(12.0, publications, [GOOD, replace(GOOD, camera="cam02")])


@pytest.mark.stability
def test_nothing_is_said_of_a_better_picture_and_of_what_is_not_known():
    for scores in ([13.0] * FLAT_SCORES, [5.0] * (FLAT_SCORES - 1), [float("nan")] * FLAT_SCORES, []):
        assert poor_picture(12.0, scored(*scores), [GOOD]) == ""
    assert poor_picture(None, scored(*[5.0] * FLAT_SCORES), [GOOD]) == ""
