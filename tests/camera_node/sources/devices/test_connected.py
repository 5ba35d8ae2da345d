"""The list of cameras that are plugged in, on a machine of files."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import ANY

from camera_node.cli import main
from camera_node.sources.devices import oak, realsense
from camera_node.sources.devices.connected import Connected, connected
from camera_node.sources.devices.feed import Plugged


def test_video_devices_are_listed_with_the_name_that_lasts(tmp_path: Path) -> None:
    for number, index, name in ((0, 0, "HD Webcam"), (1, 1, "HD Webcam"), (10, 0, "Other")):
        entry = tmp_path / f"sys/class/video4linux/video{number}"
        entry.mkdir(parents=True)
        (entry / "index").write_text(f"{index}\n")
        (entry / "name").write_text(f"{name}\n")
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / f"dev/video{number}").touch()
    links = tmp_path / "dev/v4l/by-id"
    links.mkdir(parents=True)
    (links / "usb-HD_Webcam-video-index0").symlink_to("../../video0")
    found = [camera for camera in connected(tmp_path) if camera.kind == "camera"]
    assert found == [
        Connected("camera", "0", "HD Webcam; the same at every start: /dev/v4l/by-id/usb-HD_Webcam-video-index0"),
        Connected("camera", "10", "Other"),
    ]


def test_devices_of_a_library_are_listed_by_serial_number_and_its_trouble_in_their_place(monkeypatch, capsys) -> None:
    def being_plugged_in() -> list[Plugged]:
        raise RuntimeError("busy")

    monkeypatch.setattr(oak, "plugged_in", lambda: [Plugged("14", "OAK-D unlocked")])
    monkeypatch.setattr(realsense, "plugged_in", being_plugged_in)
    assert main(["devices"]) == 0
    said = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert "camera" in {kind for kind, _ in said} and said[-2:] == [["oak", ANY], ["realsense", ANY]]
    assert "14" in said[-2][1] and "OAK-D unlocked" in said[-2][1] and "busy" in said[-1][1]
