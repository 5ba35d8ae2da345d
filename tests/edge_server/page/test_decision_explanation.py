"""The explanation folder: shown only for learned policies, computed once a decision, regions on demand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import viser

from edge_server.page import markup
from edge_server.page.colors import AGAINST, FOR, css
from edge_server.page.decision_explanation import WIDTH, DecisionExplanation, tinted
from edge_server.scheduler.learned.explain import explain
from tests.edge_server.page.test_page import bare_state
from tests.edge_server.scheduler.learned.test_decision_record import a_decision


@pytest.fixture
def gui():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server.gui
    server.stop()


def colors(images):
    return np.array([image.mean(axis=(0, 1)) / 64.0 for image in images], np.float32)


def test_it_is_hidden_without_a_learned_policy(gui):
    explanation = DecisionExplanation(gui, bare_state())
    explanation.refresh()
    assert not explanation._folder.visible
    assert explanation._text.content == ""


def test_a_decision_is_explained_once(gui):
    state, now = bare_state(), a_decision(3)
    asked = []
    state.decision = lambda: asked.append(1) or now
    explanation = DecisionExplanation(gui, state)
    explanation.refresh()
    first = explanation._text.content
    assert explanation._folder.visible and "views" in first and "semantics" in first
    explanation._text.content = "kept"
    explanation.refresh()
    assert explanation._text.content == "kept"
    now = a_decision(4)
    explanation.refresh()
    assert "views" in explanation._text.content
    assert not explanation._button.visible  # nothing embeds here


def test_regions_are_shown_on_request(gui):
    state, now = bare_state(), a_decision(3)
    state.decision, state.embed = lambda: now, colors
    explanation = DecisionExplanation(gui, state)
    explanation.refresh()
    assert explanation._button.visible and explanation._image is None
    for _ in range(2):
        explanation._clicked(None)
        explanation.refresh()
        assert explanation._image.image.shape == (WIDTH * 24 // 32, WIDTH, 3)


def test_an_image_that_cannot_be_decoded_is_skipped(gui):
    given = a_decision(3)
    frames = {c: replace(f, payload=b"\xff\xd8 nothing") for c, f in given.state.frames.items()}
    now = replace(given, state=replace(given.state, frames=frames))
    state = bare_state()
    state.decision, state.embed = lambda: now, colors
    explanation = DecisionExplanation(gui, state)
    explanation._clicked(None)
    explanation.refresh()
    assert explanation._image is None and explanation._text.content


def test_the_text_names_what_counted_and_escapes_what_came_from_outside():
    given = a_decision(1)
    found = explain(given.actor, given.state, given.action)
    html = markup.decision_explanation(replace(found, names=("<b>x", *found.names[1:])))
    assert "<b>x" not in html and "&lt;b&gt;x" in html
    assert css(FOR) in html and css(AGAINST) in html
    nothing = replace(found, parts={"age": 0.0}, cameras=np.zeros(0), names=())
    assert "width:0%" in markup.decision_explanation(nothing)


def test_only_regions_that_contributed_are_tinted():
    image = np.full((48, 64, 3), 100, np.uint8)
    regions = np.zeros((8, 8))
    regions[0, 0], regions[7, 7] = 1.0, -1.0
    found = tinted(image, regions)
    assert found.shape == (240, WIDTH, 3) and found.dtype == np.uint8
    assert (found[100:140, 140:180] == 100).all()
    assert found[2, 2, 2] > 130 > 70 > found[2, 2, 0]  # blue
    assert found[-2, -2, 0] > 130 > 70 > found[-2, -2, 2]  # vermillion
    assert (tinted(image, np.zeros((8, 8))) == 100).all()
