"""Tables hold every row, and what is missing stays empty."""

from __future__ import annotations

from edge_server.experiments.common.tables import markdown_table, mean_or_none, median_or_none, number, over_seeds


def test_numbers_and_cells():
    assert markdown_table(("a", "b"), [(1, None)]) == "| a | b |\n| --- | --- |\n| 1 |  |"
    assert number(None) == number(float("nan")) == "-" and number(1.0, 1, "+") == "+1.0"


def test_averages_leave_out_what_is_missing():
    assert median_or_none([3.0, None, 1.0, 5.0]) == 3.0 and mean_or_none([1.0, None, 4.0]) == 2.5
    assert median_or_none([None]) is None and mean_or_none([]) is None
    rows = [{"scene": "a", "db": 1.0}, {"scene": "b", "db": 5.0}, {"scene": "a", "db": None}, {"scene": "a", "db": 2.0}]
    assert over_seeds(rows, ("scene",), ("db",), mean_or_none) == [
        {"scene": "a", "seeds": 3, "db": 1.5},
        {"scene": "b", "seeds": 1, "db": 5.0},
    ]
