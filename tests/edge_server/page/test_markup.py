"""The panel's text and charts: from outside it is escaped, unknown values are dashes; a poor picture's likely cause."""

from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest

from edge_server.live.state import CameraView, Publication
from edge_server.page import markup, timelines
from edge_server.page.colors import FRESH, HELD_OUT, STALE, css, scale_color
from edge_server.page.diagnosis import poor_picture
from edge_server.page.page_constants import CHART_POINTS, FLAT_SCORES
from edge_server.page.timelines import History
from edge_server.run_records import Frontier, FrontierPoint, age_parts_ms
from tests.edge_server.page.preview import publication


def summary(**changes) -> markup.Summary:
    words = {"scenario": "room", "field": "ngp", "doing": "fitting", "condition": "live", "scored_on": "cam00"}
    counts = {"updates": 41, "reporting": 12, "cameras": 13, "t_s": 75.0}
    values = {"update_ms": 812.4, "psnr_db": 25.31, "mean_age_ms": 130.2, "worst_age_ms": 411.0}
    return markup.Summary(**(words | counts | values | {"age_parts_ms": {}} | changes))


def test_unknown_values_are_dashes():
    html = markup.status(summary(psnr_db=None, update_ms=None, mean_age_ms=None, worst_age_ms=float("nan")))
    assert html.count("&ndash;") == 4 and "nan" not in html and "None" not in html
    assert markup.number(float("inf")) == "&infin;"  # PSNR of equal images


def test_the_age_of_what_is_shown_is_split_into_its_parts():
    def publication(t_s: float, network_ms: float | None, number: int = 0) -> Publication:
        return Publication(number, t_s, 0, None, ("cam01",), (100.0,), 100.0, 20.0, network_ms=network_ms)

    three = [publication(t_s, 50.0, number) for number, t_s in enumerate((0.0, 0.02, 0.08))]
    parts = age_parts_ms(three, 0.08)
    # A random instant lies in the long gap three times out of four, and then 30 ms after its begin.
    assert parts == pytest.approx({"network": 50.0, "waiting": 30.0, "computing": 20.0, "display": 25.0})
    html = markup.status(summary(age_parts_ms=parts))
    assert "125 ms" in html and "width:40.0%" in html
    assert all(css(scale_color(k / 3)) in html for k in range(4))
    assert age_parts_ms(three[:1], 0.0) == age_parts_ms([publication(t, None) for t in (0, 1)], 1.0) == {}
    # Of updates 1 and 2 no line was written: they lie evenly between those of 0 and 3.
    assert age_parts_ms([three[0], publication(0.06, 50.0, 3)], 0.06)["display"] == pytest.approx(10.0)
    # In a blackout nothing is published.
    assert age_parts_ms(three, 20.08)["display"] == pytest.approx(10_000.0, rel=0.01)


def test_the_frontier_stands_beside_the_present_or_says_how_to_measure_it():
    measured = ((50.0, 20.0), (800.0, 24.0), (200.0, 28.0))
    found = Frontier([FrontierPoint(ms, db, db - 4.0) for ms, db in measured], "f.json, at <1> m/s")
    html = markup.frontier(found, (200.0, 28.0, None))
    assert html.count("<circle") == 1 and 'cx="170.0" cy="8.0"' in html, "at the best point, half way"
    assert "50 ms an update" in html and "at &lt;1&gt; m/s" in html
    unknown = Frontier([], "run `edge-server frontier --field x`")
    assert "edge-server frontier --field x" in markup.frontier(unknown, None)


def test_what_comes_from_outside_is_escaped():
    evil = "<img src=x onerror=alert(1)>"
    camera = CameraView(evil, False, None, None, 0, 0)
    pages = [
        markup.status(summary(scenario=evil, field=evil, doing=evil, scored_on=evil, condition="live")),
        markup.html("table", [camera]),
        markup.comparison_caption(evil, None, 0, True),
        markup.html("chart_caption", evil, [(evil, (0, 0, 0))]),
        markup.html("chart_caption", "", [], evil),
        markup.html("note", evil),
        markup.channel_line({"preset": evil, "counts": 3, "drawn_delay_ms": {"mean": None}}),
    ]
    assert not any("<img" in page or "None" in page for page in pages)
    said = {"preset": "ch5", "drawn_delay_ms": {"mean": 60.4}, "counts": {"forwarded": 481, "lost": 0}}
    assert "ch5, mean delay 60 ms, 481 forwarded<" in markup.channel_line(said)


def test_the_table_marks_age_truth_use_and_refusals():
    cameras = [
        CameraView("cam00", True, None, 40.0, 5, 0),
        CameraView("cam01", False, None, 9000.0, 7, 3),
        CameraView("cam02", False, None, None, 0, 0),
    ]
    rows = markup.html("table", cameras, ["cam01"]).split("<tr>")[2:]
    assert "truth" in rows[0] and css(HELD_OUT) in rows[0]
    assert "9000 ms" in rows[1] and "&#10003;" in rows[1] and css(STALE) in rows[1] and ">3<" in rows[1]
    assert "no frame yet" in rows[2] and "&#10003;" not in rows[2]


def test_a_decision_is_told_in_words():
    ages = {"cam01": 40.0, "cam02": 903.4, "cam03": 55.0, "cam04": 700.0, "cam05": 650.0, "cam06": 800.0}
    cameras = [CameraView(name, False, None, age, 1, 0) for name, age in ages.items()]
    cameras += [CameraView("cam00", True, None, 10.0, 1, 0), CameraView("cam09", False, None, None, 0, 0)]

    def words(selected, omega_ms=None, policy="all", **more) -> str:
        last = Publication(7, 1.0, 0, omega_ms, selected, (1.0,) * len(selected), 1.0, 20.0, **more)
        return markup.decision_words(last, cameras, policy)

    assert "Update 7 uses all 6 views." in words(tuple(ages))  # the number that the caption and explain use
    assert "waits 62 ms, then uses all 6 views." in words(tuple(ages), 62.0, "wait-arrived")
    old = words(("cam01", "cam03"), 120.0, "threshold")
    assert "uses 2 of 6 views, up to 120 ms old; leaves out cam02 (903 ms old), cam06 (800 ms old)" in old
    assert "cam04 (700 ms old) and 1 more." in old and "cam00" not in old
    assert "cam05 (650 ms old)." in words(("cam01", "cam03", "cam04"))  # three are named, and no more is there
    assert "refuses cam03, which contradict the others" in words(tuple(ages), refused=("cam03",))


GOOD = CameraView("cam01", False, None, 80.0, 100, 3)
CASES = {
    "for this machine.": [GOOD, replace(GOOD, camera="cam02"), replace(GOOD, camera="cam00", held_out=True)],
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


@pytest.mark.stability
def test_nothing_is_said_of_a_better_picture_and_of_what_is_not_known():
    for scores in ([13.0] * FLAT_SCORES, [5.0] * (FLAT_SCORES - 1), [float("nan")] * FLAT_SCORES, []):
        assert poor_picture(12.0, scored(*scores), [GOOD]) == ""
    assert poor_picture(None, scored(*[5.0] * FLAT_SCORES), [GOOD]) == ""


def views(*ages: float | None) -> list[CameraView]:
    held_out = CameraView("truth", True, None, 1.0, 0, 0)
    return [held_out, *(CameraView(f"c{i}", False, None, a, 0, 0) for i, a in enumerate(ages))]


def test_history_keeps_the_window_and_leaves_the_held_out_camera_aside():
    history = History(window_s=10.0)
    for i in range(1000):
        history.sample(0.1 * i, views(100.0, 300.0, None), {"state": "high"})
    t, mean, worst, state = history.columns()
    assert t[0] >= t[-1] - 10.0 and len(t) <= 102
    assert np.allclose(mean, 200.0) and np.allclose(worst, 300.0) and np.allclose(state, 0.0)
    history.sample(5.0, views(1.0), None)
    assert len(history.columns()[0]) == len(t), "time that goes back"


def test_the_charts_show_ages_scored_updates_of_the_window_and_states_by_name():
    gui, made = MagicMock(), []
    gui.add_uplot.side_effect = lambda **props: made.append(MagicMock(**props)) or made[-1]
    captions = []
    gui.add_html.side_effect = lambda *words, **props: captions.append(MagicMock(**props)) or captions[-1]
    history, charts = History(window_s=1000.0), timelines.Timelines(gui)
    history.sample(0.0, views(100.0, 300.0), {"state": "high", "states": ["low", "high"]})
    charts.refresh(history, [])
    assert not made  # one point is no line
    for t in (100.0, 200.0):
        history.sample(t, views(100.0, 500.0), {"state": "low"})
    rows = ((10.0, 15.0, 40.0), (90.0, 20.0, 50.0), (190.0, None, 60.0), (195.0, 22.0, 60.0))
    publications = [
        Publication(k, t_s, 0, omega_ms, (), (), 0.0, 0.0, psnr_db=db, psnr_moving_db=db, scored_on="truth")
        for k, (t_s, db, omega_ms) in enumerate(rows)
    ]
    charts.refresh(history, publications)
    age, psnr, channel = ([column.tolist() for column in chart.data] for chart in made)
    # A gap has the value beside it; of what came before the charts begin, nothing is shown.
    assert age == [[0, 100, 200], [200, 300, 300], [300, 500, 500], [50, 50, 60]]
    assert psnr == [[90.0, 195.0], [20.0, 22.0], [20.0, 22.0]]
    assert channel == [[0, 100, 100, 200, 200], [1, 1, 0, 0, 0]]  # a staircase
    assert "dB" in captions[1].content and "0 good, 1 bad" in captions[2].content
    assert [line["label"] for line in made[0].series] == ["s", "mean", "worst", "omega"]
    assert made[0].series[1]["stroke"] == css(FRESH) and made[0].scales["y"] == {"range": (0.0, None)}
    charts.refresh(history, [])
    assert made[0].remove.called and len(made[3].data) == 3  # without the line that has no values
    history.sample(201.0, views(100.0, 500.0), None)
    charts.refresh(history, [])
    assert len(made) == 4 and len(made[3].data[0]) == 4
    for k in range(799):
        history.sample(202.0 + k, views(1000.0 + k), None)
    charts.refresh(history, [])
    t, mean, _ = made[-1].data  # thinned, with the newest
    assert len(t) <= CHART_POINTS and t[-1] == 1000.0 and np.array_equal(mean[-9:], t[-9:] + 798.0)
