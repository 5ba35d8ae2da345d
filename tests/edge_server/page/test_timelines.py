"""The data of the charts: bounded, without gaps that a chart cannot draw."""

from __future__ import annotations

from unittest.mock import MagicMock

import numpy as np

from edge_server.live.state import CameraView, Publication
from edge_server.page import timelines
from edge_server.page.timelines import MAX_POINTS, RECENT, History, _decimate


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
    assert np.isnan(history.columns()[1]).all()  # no camera has reported
    chains = {"a": {"state": "low"}, "b": {"state": "high"}, "c": {}, "d": 3}
    history.sample(9.0, views(), {"state": None, "by_camera": chains})
    history.sample(10.0, views(), {"states": 7, "by_camera": [1], "state": None})
    assert history.columns()[3][-2] == 0.5 and np.isnan(history.columns()[3][-1])


def test_the_charts_show_ages_scored_updates_of_the_window_and_states_by_name(monkeypatch):
    drawn = []

    def draw(chart, t, *curves, remark=""):
        drawn.append((chart.title, t.tolist(), [curve.tolist() for curve in curves], remark))

    monkeypatch.setattr(timelines._Chart, "draw", draw)
    history = History(window_s=1000.0)
    for t in (0.0, 200.0):
        history.sample(t, views(100.0, 300.0), {"state": "high", "states": ["low", "high"]})
    scores = ((10.0, 15.0), (90.0, 20.0), (190.0, None), (195.0, 22.0))
    publications = [
        Publication(k, t_s, 0, 50.0, (), (), 0.0, 0.0, psnr_db=db, psnr_moving_db=db, scored_on="truth")
        for k, (t_s, db) in enumerate(scores)
    ]
    timelines.Timelines(MagicMock()).refresh(history, publications)
    (_, t, (mean, worst, omega), _), (title, when, (psnr, _), _), (_, _, (state,), names) = drawn
    assert (t, mean, worst) == ([0.0, 200.0], [200.0, 200.0], [300.0, 300.0])
    assert np.isnan(omega[0]) and omega[1] == 50.0
    assert (when, psnr) == ([90.0, 195.0], [20.0, 22.0]) and title.endswith(", dB")
    assert state == [1.0, 1.0] and names == "0 good, 1 bad"


def test_a_chart_draws_lines_with_recent_values_and_is_made_anew_where_they_change():
    gui, made = MagicMock(), []
    gui.add_uplot.side_effect = lambda **props: made.append(MagicMock(**props)) or made[-1]
    chart = timelines._Chart(gui, "Age", (("mean", (0, 1, 2)), ("omega", (3, 4, 5))), zero=True)
    t = np.arange(RECENT + 2.0)
    omega = np.full(len(t), np.nan)
    chart.draw(t[:1], t[:1], omega[:1])
    assert not made  # one point is no line
    chart.draw(t[:2], t[:2], omega[:2])
    assert [column.tolist() for column in made[0].data] == [[0.0, 1.0]] * 2
    assert [(line["label"], line.get("stroke")) for line in made[0].series] == [("s", None), ("mean", "#000102")]
    assert made[0].scales == {"x": {"time": False}, "y": {"range": (0.0, None)}}
    omega[2] = 7.0  # the first of the last RECENT rows
    chart.draw(t, t, omega)
    assert len(made) == 2 and made[0].remove.called and made[1].data[2].tolist() == [7.0] * len(t)
    omega[1:] = [7.0, *[np.nan] * RECENT]
    chart.draw(t, t, omega)
    assert len(made) == 3 and len(made[2].data) == 2
    chart.draw(t, 2 * t, omega)
    assert len(made) == 3 and made[2].data[1].tolist() == (2 * t).tolist()


def test_a_stepped_chart_is_a_staircase_and_a_long_one_is_thinned_and_keeps_the_newest():
    gui, t = MagicMock(), np.arange(1000.0)
    timelines._Chart(gui, "Channel", (("state", (0, 1, 2)),), stepped=True).draw(t[:2], t[:2])
    assert [column.tolist() for column in gui.add_uplot.call_args.kwargs["data"]] == [[0, 1, 1], [0, 0, 1]]
    thin_t, thin_y = _decimate(t, 2 * t)
    assert len(thin_t) <= MAX_POINTS and thin_t[-1] == 999 and np.array_equal(thin_y, 2 * thin_t)
