"""The data of the charts: bounded, without gaps that a chart cannot draw."""

from __future__ import annotations

from unittest.mock import MagicMock

import numpy as np

from edge_server.live.state import CameraView, Publication
from edge_server.page import timelines
from edge_server.page.colors import FRESH, css
from edge_server.page.timelines import MAX_POINTS, History, _decimate


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


def test_states_are_numbered_by_the_emulators_list_or_as_they_come_and_averaged_over_cameras():
    history = History()
    said = [{"state": "high", "states": ["low", "high"]}, {"state": "low"}, {}, None, {"state": 2}]
    for i, status in enumerate([*said, {"state": [1]}]):
        history.sample(float(i), views(), status)
    assert history.state_names == ["low", "high", "2"]
    state = history.columns()[3]
    assert state[:2].tolist() == [1, 0] and np.isnan(state[[2, 3, 5]]).all() and state[4] == 2
    chains = {"a": {"state": "low"}, "b": {"state": "high"}, "c": {}, "d": 3}
    history.sample(9.0, views(), {"state": None, "by_camera": chains})
    history.sample(10.0, views(), {"states": 7, "by_camera": [1], "state": None})
    assert history.columns()[3][-2] == 0.5 and np.isnan(history.columns()[3][-1])


def test_the_charts_show_ages_scored_updates_of_the_window_and_states_by_name():
    gui, made = MagicMock(), []
    gui.add_uplot.side_effect = lambda **props: made.append(MagicMock(**props)) or made[-1]
    captions = []
    gui.add_html.side_effect = lambda *words, **props: captions.append(MagicMock(**props)) or captions[-1]
    history, charts = History(window_s=1000.0), timelines.Timelines(gui)
    history.sample(0.0, views(100.0, 300.0), {"state": "high", "states": ["low", "high"]})
    charts.refresh(history, [])
    assert not made  # one point is no line
    history.sample(200.0, views(100.0, 500.0), {"state": "low"})
    publications = [
        Publication(k, t_s, 0, 50.0, (), (), 0.0, 0.0, psnr_db=db, psnr_moving_db=db, scored_on="truth")
        for k, (t_s, db) in enumerate(((10.0, 15.0), (90.0, 20.0), (190.0, None), (195.0, 22.0)))
    ]
    charts.refresh(history, publications)
    age, psnr, channel = ([column.tolist() for column in chart.data] for chart in made)
    assert age == [[0.0, 200.0], [200.0, 300.0], [300.0, 500.0], [50.0, 50.0]]  # a gap: the value beside it
    assert psnr == [[90.0, 195.0], [20.0, 22.0], [20.0, 22.0]]
    assert channel == [[0.0, 200.0, 200.0], [1.0, 1.0, 0.0]]  # a staircase
    assert "dB" in captions[1].content and "0 good, 1 bad" in captions[2].content
    assert [line["label"] for line in made[0].series] == ["s", "mean", "worst", "omega"]
    assert made[0].series[1]["stroke"] == css(FRESH) and made[0].scales["y"] == {"range": (0.0, None)}
    charts.refresh(history, [])
    assert made[0].remove.called and len(made[3].data) == 3  # without the line that has no values
    history.sample(201.0, views(100.0, 500.0), None)
    charts.refresh(history, [])
    assert len(made) == 4 and len(made[3].data[0]) == 3


def test_a_long_chart_is_thinned_and_keeps_the_newest():
    t = np.arange(1000.0)
    thin_t, thin_y = _decimate(t, 2 * t)
    assert len(thin_t) <= MAX_POINTS and thin_t[-1] == 999 and np.array_equal(thin_y, 2 * thin_t)
