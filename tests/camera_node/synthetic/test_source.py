"""Cameras of the world and their frames on disk: right, found again, shared, and rendered again when damaged."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import pytest

from camera_node.synthetic import frame_cache, make_scene
from camera_node.synthetic import source as source_module
from camera_node.synthetic.frame_cache import prune
from camera_node.synthetic.source import WorldSource
from freshfield import payload

SMALL = {"width": 32, "height": 32, "supersample": 1, "speed_m_per_s": 8.0}  # 0.6 s: few frames


def room(**changes):
    return make_scene("room", {**SMALL, **changes})


def source(scene=None, fps=15, camera="cam01", **options) -> WorldSource:
    return WorldSource("eye", scene or room(), camera, fps, **options)


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize(("fps", "frames"), [(15, 9), (Fraction(100, 3), 20), (24, 72), (29.97, None)])
def test_the_sequence_repeats_after_whole_periods(fps, frames):
    """Frame numbers count to the first common multiple of period and frame time (29.97: 8991 are too many)."""
    made = source(fps=fps)
    assert made.repeats_after == made.contents == frames
    assert source(make_scene("tile", {"width": 32, "height": 32})).contents == 1, "a static scene is one frame"


def test_a_frame_is_the_scene_at_its_instant_for_ever(tmp_path):
    scene = room()
    made = source(scene, folder=tmp_path)
    for tick in (0, 1, 8, 9, 10, 9 * 10**12 + 4):
        expected = payload.encode(scene.render("cam01", (tick % 9) / 15), "jpeg", 92)
        assert made.read(made.content(tick)).image == made.read(tick).image == expected
    endless = source(fps=29.97, folder=tmp_path / "endless")
    endless.prepare(lambda: False)
    t_s = float(Fraction(1000) / Fraction(2997, 100))
    assert endless.read(endless.content(1000)).image == payload.encode(scene.render("cam01", t_s), "jpeg", 92)
    assert files(tmp_path / "endless") == [], "what does not repeat is rendered as it goes"


@pytest.mark.parametrize("codec", payload.CODECS)
def test_prepared_once_nothing_is_rendered_again(tmp_path, codec, monkeypatch):
    first = source(codec=codec, folder=tmp_path)
    first.prepare(lambda: len(files(tmp_path)) >= 3)
    assert len(files(tmp_path)) == 3
    first.prepare(lambda: False)
    again = source(codec=codec, folder=tmp_path)
    monkeypatch.setattr(again, "_render", None)
    again.prepare(lambda: False)
    assert [again.read(k).image for k in range(9)] == [first.read(k).image for k in range(9)]


@pytest.mark.parametrize("damage", [b"", b"\xff\xd8\xff\xe0" * 200])
def test_a_damaged_entry_is_rendered_again_and_a_folder_that_cannot_be_written_costs_only_time(tmp_path, damage):
    source(folder=tmp_path).prepare(lambda: False)
    victim = files(tmp_path)[3]
    whole = victim.read_bytes()
    victim.write_bytes(damage)
    assert source(folder=tmp_path).read(3).image == whole == victim.read_bytes()
    blocked = source(folder=victim)
    for _ in range(2):
        assert blocked.read(3).image == whole and "Not a directory" in blocked.cache.error
        blocked.prepare(lambda: False)


def test_the_key_follows_all_that_decides_the_bytes(monkeypatch):
    base = source().key()
    assert source(fps=15.0).key() == source(room(count=5)).key() == base
    others = [
        source(camera="cam02"),
        source(fps=30),
        source(codec="png"),
        source(quality=80),
        source(phase_ns=1),
        source(room(supersample=2)),
        source(room(horizontal_fov_deg=50.0)),
    ]
    assert len({base, *(made.key() for made in others)}) == len(others) + 1
    monkeypatch.setattr(source_module, "renderer_version", lambda: "another renderer")
    assert source().key() != base


def test_the_first_frame_a_process_writes_makes_room_and_the_longest_unused_goes_first(tmp_path, monkeypatch):
    for k in range(4):
        folder = tmp_path / f"{k:032x}"
        folder.mkdir()
        (folder / "000000.jpeg").write_bytes(bytes(1000))
        os.utime(folder, (1000 + k, 1000 + k))
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "weights").write_bytes(bytes(10**5))
    assert prune(tmp_path, keep=tmp_path / f"{0:032x}", limit_bytes=2500) == 2000
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{0:032x}", f"{3:032x}", "models"]
    monkeypatch.setattr(frame_cache, "_pruned", set())
    monkeypatch.setattr(frame_cache, "MAX_DISK_BYTES", 1000)
    source(folder=tmp_path).prepare(lambda: False)
    assert not (tmp_path / f"{0:032x}").exists() and len(files(tmp_path)) == 9 + 2
