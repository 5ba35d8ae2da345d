"""The contact sheet as a command: it says how far it is, and ends in one line."""

from __future__ import annotations

import cv2
import pytest

from camera_node.synthetic.preview import main
from camera_node.synthetic.scene import Scene


def test_it_says_how_far_it_is_and_where_the_sheet_is(tmp_path, capsys):
    file = tmp_path / "new" / "tile.png"
    assert main(["tile", "--out", str(file), "--size", "8", "--set", "count=2"]) == 0
    said = capsys.readouterr()
    assert said.out == f"{file}\n" and said.err == "  cam00: 1 of 2 pictures\n  cam01: 2 of 2 pictures\n"
    assert cv2.imread(str(file)).shape == (10, 19, 3)


def test_ctrl_c_and_mistakes_end_in_a_line(tmp_path, capsys, monkeypatch):
    file = tmp_path / "tile.png"
    with pytest.raises(SystemExit, match="2"):
        main(["tile", "--out", str(file), "--size", "0"])
    assert "width is 0, expected 8 to 4096" in capsys.readouterr().err

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Scene, "render", interrupted)
    assert main(["tile", "--out", str(file), "--size", "8"]) == 130
    assert capsys.readouterr().err == "\nstopped; nothing was written\n" and not file.exists()
