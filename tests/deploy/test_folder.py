"""Which folders a run may use: a mistyped --out must never cost anybody a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from freshfield_up.folder import EARLIER, KEY, MARKER, FolderError, forget_earlier, prepare


def test_an_earlier_run_outlives_starts_that_fail(tmp_path: Path) -> None:
    prepare(tmp_path, {"run": 1}).close()
    (tmp_path / "report.json").write_text("good")
    for failed in (2, 3):
        prepare(tmp_path, {"run": failed}).close()
        (tmp_path / "log-edge.txt").write_text(f"start {failed} failed")
    assert [p.name for p in (tmp_path / EARLIER).iterdir()] == ["report.json"]
    assert {p.name for p in tmp_path.iterdir()} == {MARKER, EARLIER, "log-edge.txt"}


def test_a_start_that_is_killed_before_its_marker_is_written_or_while_it_moves_files_loses_none(tmp_path: Path) -> None:
    (tmp_path / MARKER).touch()
    prepare(tmp_path, {"run": 1}).close()
    for name in ("field.npz", "edge.json"):
        (tmp_path / name).write_text(name)
    part = tmp_path / f".{EARLIER}"
    part.mkdir()
    (tmp_path / "edge.json").rename(part / "edge.json")
    prepare(tmp_path, {"run": 2}).close()
    assert {p.name for p in (tmp_path / EARLIER).iterdir()} == {"field.npz", "edge.json"} and not part.exists()


def test_an_earlier_run_is_replaced_and_a_link_in_it_is_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "photo").write_text("keep")
    out = tmp_path / "out"
    prepare(out, {"run": 1}).close()
    for name in ("ledger-edge-edge-1.tsv", "frontier.json", ".edge.json.4f.part"):
        (out / name).write_text("old")
    (out / "decisions").symlink_to(precious)
    prepare(out, {"run": 2}).close()
    forget_earlier(out)
    assert list(out.iterdir()) == [out / MARKER] and (precious / "photo").read_text() == "keep"
    assert json.loads((out / MARKER).read_text()) == {KEY: [], "run": 2}


@pytest.mark.parametrize(
    ("marker", "error"),
    [
        (None, "not an earlier run's"),
        (json.dumps({KEY: [1]}), "not of a run of this version"),
        ("", "not of a run of this version"),
        (json.dumps({KEY: []}), "holds thesis.tex, which no run wrote"),
    ],
)
def test_anything_else_is_refused_and_left_alone(tmp_path: Path, marker: str | None, error: str) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "edge.json").write_text("{}")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    with pytest.raises(FolderError, match=error):
        prepare(tmp_path, {})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before


def test_a_run_that_is_still_going_on_and_a_file_in_the_place_of_the_folder_are_refused(tmp_path: Path) -> None:
    with prepare(tmp_path, {"run": 1}), pytest.raises(FolderError, match="another run is writing"):
        prepare(tmp_path, {"run": 2})
    assert json.loads((tmp_path / MARKER).read_text()) == {KEY: [], "run": 1}
    with pytest.raises(FolderError, match="cannot use"):
        prepare(tmp_path / MARKER, {})
