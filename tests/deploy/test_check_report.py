"""What continuous integration refuses in a run's report."""

from __future__ import annotations

import json

import pytest

from tests.edge_server.report.ledgers import write
from tests.edge_server.report.sample_run import write_run
from tests.tools.check_report import problems


def found(out):
    from edge_server.report.build_report import build_report

    build_report(out)
    return "\n".join(problems(out))


@pytest.mark.slow  # 4 s
def test_lost_lines_and_contradictions_are_refused(tmp_path):
    write_run(tmp_path)
    assert "ledger" not in found(tmp_path) and "accounted" not in found(tmp_path)
    path = write(tmp_path, "node", [], name="late", start_ns=9, closed=False)
    with path.open("a") as file:
        file.write("6\t\t\t0\tclosed\t2014\n")
    text = found(tmp_path)
    assert "not true: no line of a ledger was lost" in text
    assert "accounted for (2,014 lines of the ledgers were lost)" in text
    write(tmp_path, "edge", [("cam00", "s1", 4, "delivered")], name="other", start_ns=9)
    assert "not true: no two ledgers contradict each other" in found(tmp_path)


@pytest.mark.parametrize("name", ["report.json", "report.html"])
def test_a_missing_report_is_named(tmp_path, name):
    for other in {"report.json", "report.html"} - {name}:
        (tmp_path / other).write_text(json.dumps({}))
    assert problems(tmp_path) == [f"{tmp_path / name} is missing"]
