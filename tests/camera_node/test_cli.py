"""The command as a person meets it."""

from __future__ import annotations

import pytest

from camera_node.cli import main


def fails(capsys, *arguments: str) -> str:
    assert main(list(arguments)) == 2
    said = capsys.readouterr().err
    assert said.startswith("camera-node: ") and said.count("\n") == 1
    return said


def test_mistakes_are_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    to = ("--to", "127.0.0.1:1")
    assert "shipped scenarios: " in fails(capsys, "run", "nope", "--all", *to)
    assert "--camera-index 13: expected 0 to 12" in fails(capsys, "run", "room", "--camera-index", "13", *to)
    assert "has no camera cam77; it has cam00, " in fails(capsys, "run", "room", "--camera", "cam01,cam77", *to)
    for wrong in ("host", "host:0", "::1", "http://host:80"):
        assert "--to: expected HOST:PORT" in fails(capsys, "run", "room", "--all", "--to", wrong)
    for wrong in ("-1", "nan"):
        assert "--seconds: expected" in fails(capsys, "run", "room", "--all", "--seconds", wrong, *to)
    assert "cannot read" in fails(capsys, "run", "room", "--all", "--token-file", str(tmp_path / "no"), *to)
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match="2"):
        main(["run", "tile", "--all", "--out", str(tmp_path / "file/x"), *to])
    assert "--out: " in capsys.readouterr().err
    (tmp_path / "bad.yaml").write_text("cameras: {count: 20}\nsource: {kind: world, scene: room}\n")
    assert "bad.yaml: source: " in fails(capsys, "run", str(tmp_path / "bad.yaml"), "--all", *to)
