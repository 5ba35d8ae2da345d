"""The explanation folder: shown only for learned policies, computed once a decision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import viser

from edge_server.page import markup
from edge_server.page.colors import AGAINST, FOR, css
from edge_server.page.decision_explanation import DecisionExplanation
from edge_server.scheduler.learned.explain import explain
from tests.edge_server.page.test_page import bare_state
from tests.edge_server.scheduler.learned.test_decision_record import a_decision


@pytest.fixture
def gui():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server.gui
    server.stop()


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


def test_the_text_names_what_counted_and_escapes_what_came_from_outside():
    given = a_decision(1)
    found = explain(given.actor, given.state, given.action)
    html = markup.decision_explanation(replace(found, names=("<b>x", *found.names[1:])))
    assert "<b>x" not in html and "&lt;b&gt;x" in html
    assert css(FOR) in html and css(AGAINST) in html
    nothing = replace(found, parts={"age": 0.0}, cameras=np.zeros(0), names=())
    assert "width:0%" in markup.decision_explanation(nothing)
