"""Frames on disk: right, found again, shared, and rendered again when damaged."""

from __future__ import annotations

import multiprocessing
import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from camera_node.synthetic import frame_cache as cache_module
from camera_node.synthetic import make_scene
from camera_node.synthetic.effects import load_effects
from camera_node.synthetic.frame_cache import FrameCache, default_folder, prune
from freshfield import payload

SMALL = {"width": 32, "height": 32, "supersample": 1, "speed_m_per_s": 8.0}  # 0.6 s: few frames


def room(**changes):
    return make_scene("room", {**SMALL, **changes})


def effects(**listed):
    return load_effects(listed, lambda name: np.random.default_rng(5))


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize(
    ("fps", "frames"), [(15, 9), (Fraction(100, 3), 20), (30.0, 18), (24, 72), (25, 15), (29.97, 8991)]
)
def test_the_sequence_repeats_after_whole_periods(fps, frames):
    """Frame numbers count to the first common multiple of period and frame time (29.97: too long)."""
    c = FrameCache(room(), "cam01", fps, on_disk=False)
    expected = frames if frames <= cache_module.MAX_FRAMES else None
    assert c.repeats_after == c.contents == expected
    if expected:
        assert (Fraction(expected) / c.fps / Fraction(6, 10)).denominator == 1


def test_a_frame_is_the_scene_at_its_instant_for_ever(tmp_path):
    scene = room()
    c = FrameCache(scene, "cam01", 15, folder=tmp_path)
    for index in (0, 1, 8, 9, 10, 9 * 10**12 + 4):
        assert np.array_equal(c.frame(index), scene.render("cam01", (index % 9) / 15))
        expected = payload.encode(c.frame(index), "jpeg", 92)
        assert c.encoded(index) == c.read(c.content(index)) == expected


def test_a_static_scene_is_one_frame(tmp_path):
    c = FrameCache(make_scene("tile", {"width": 32, "height": 32}), "cam00", 15, folder=tmp_path)
    assert c.contents == 1 and c.content(123) == 0
    assert c.encoded(7) == c.encoded(0)
    assert len(files(tmp_path)) == 1


@pytest.mark.parametrize("codec", payload.CODECS)
def test_filled_once_nothing_is_rendered_again(tmp_path, codec, monkeypatch):
    first = FrameCache(room(), "cam01", 15, codec=codec, folder=tmp_path)
    assert first.fill() == 9
    assert first.fill() == 0
    again = FrameCache(room(), "cam01", 15, codec=codec, folder=tmp_path)
    monkeypatch.setattr(again, "_render", None)
    assert again.fill() == 0
    assert [again.encoded(k) for k in range(9)] == [first.encoded(k) for k in range(9)]


def test_frames_can_be_read_before_and_while_it_fills(tmp_path):
    c = FrameCache(room(), "cam01", 15, folder=tmp_path)
    seen = c.encoded(5)
    assert len(files(tmp_path)) == 1
    assert c.fill(stop=lambda: len(files(tmp_path)) >= 3) == 2
    assert c.fill() == 6
    assert c.encoded(5) == seen


@pytest.mark.parametrize("damage", [b"", b"rubbish", b"\xff\xd8\xff\xe0" * 200])
def test_a_damaged_entry_is_rendered_again(tmp_path, damage):
    good = FrameCache(room(), "cam01", 15, folder=tmp_path)
    good.fill()
    victim = files(tmp_path)[3]
    whole = victim.read_bytes()
    victim.write_bytes(damage)
    c = FrameCache(room(), "cam01", 15, folder=tmp_path)
    assert c.fill() == 1
    assert c.encoded(3) == good.encoded(3)
    assert victim.read_bytes() == whole


def test_the_key_follows_all_that_decides_the_bytes(monkeypatch):
    base = FrameCache(room(), "cam01", 15, on_disk=False).key()
    assert FrameCache(room(), "cam01", 15.0, on_disk=False).key() == base
    assert FrameCache(room(count=5), "cam01", 15, on_disk=False).key() == base
    others = [
        FrameCache(room(), "cam02", 15, on_disk=False),
        FrameCache(room(), "cam01", 30, on_disk=False),
        FrameCache(room(), "cam01", 15, codec="png", on_disk=False),
        FrameCache(room(), "cam01", 15, quality=80, on_disk=False),
        FrameCache(room(speed_m_per_s=4.0), "cam01", 15, on_disk=False),
        FrameCache(room(supersample=2), "cam01", 15, on_disk=False),
        FrameCache(room(horizontal_fov_deg=50.0), "cam01", 15, on_disk=False),
        FrameCache(room(), "cam01", 15, effects=effects(motion_blur={}), on_disk=False),
        FrameCache(room(), "cam01", 15, effects=effects(motion_blur={"exposure_ms": 9.0}), on_disk=False),
        FrameCache(room(), "cam01", 15, effects=effects(occluder={}), on_disk=False),
    ]
    keys = [c.key() for c in others]
    assert len({base, *keys}) == len(keys) + 1
    monkeypatch.setattr(cache_module, "renderer_version", lambda: "another renderer")
    assert FrameCache(room(), "cam01", 15, on_disk=False).key() != base


def test_noise_is_added_to_lossless_frames_and_never_repeats(tmp_path):
    scene = room()
    c = FrameCache(scene, "cam01", 15, effects=effects(sensor_noise={}), folder=tmp_path)
    assert c.contents is None and c.content(1234) == 1234
    exact = scene.render("cam01", 2 / 15)
    assert np.array_equal(c.frame(2), exact)
    a, b = c.read(2), c.read(2 + 9)
    assert isinstance(a, np.ndarray) and not np.array_equal(a, b)
    assert np.abs(a.astype(int) - exact).mean() < 6
    assert np.array_equal(FrameCache(scene, "cam01", 15, effects=effects(sensor_noise={})).read(2), a)


def test_what_does_not_repeat_is_rendered_as_it_goes(tmp_path):
    c = FrameCache(room(), "cam01", 29.97, folder=tmp_path)
    assert c.fill() == 0 and c.content(10**6) == 10**6
    t = float(Fraction(1000) / Fraction(2997, 100))
    assert np.array_equal(c.frame(1000), room().render("cam01", t))
    assert c.encoded(1000) == payload.encode(c.frame(1000), "jpeg", 92)
    assert files(tmp_path) == []


def test_a_folder_that_cannot_be_written_costs_time_not_frames(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    c = FrameCache(room(), "cam01", 15, folder=blocked)
    expected = payload.encode(room().render("cam01", 3 / 15), "jpeg", 92)
    assert c.encoded(3) == expected
    assert "file" in (c.disk_error or "")
    assert c.fill() == 0 and c.encoded(3) == expected


def test_default_folder_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "freshfield" / "frames"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_folder() == tmp_path / "home" / ".cache" / "freshfield" / "frames"


def test_the_first_frame_a_process_writes_makes_room(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_module, "_pruned", set())
    monkeypatch.setattr(cache_module, "MAX_DISK_BYTES", 1000)
    old = tmp_path / f"{0:032x}"
    old.mkdir()
    (old / "000000.jpeg").write_bytes(bytes(2000))
    c = FrameCache(room(), "cam01", 15, folder=tmp_path)
    c.fill()
    assert not old.exists() and len(files(tmp_path)) == 9


def test_prune_deletes_the_longest_unused_first_and_nothing_else(tmp_path):
    for k in range(4):
        folder = tmp_path / (f"{k:032x}")
        folder.mkdir()
        (folder / "000000.jpeg").write_bytes(bytes(1000))
        os.utime(folder, (1000 + k, 1000 + k))
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "weights").write_bytes(bytes(10**5))
    assert prune(tmp_path, keep=tmp_path / f"{0:032x}", limit_bytes=2500) == 2000
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{0:032x}", f"{3:032x}", "models"]


def _fill(folder: str, out: multiprocessing.Queue[object]) -> None:
    c = FrameCache(room(), "cam01", 15, folder=Path(folder))
    c.fill()
    out.put([c.encoded(k) for k in range(9)])


def test_several_processes_may_fill_at_once(tmp_path):
    context = multiprocessing.get_context("spawn")
    out: multiprocessing.Queue[object] = context.Queue()
    workers = [context.Process(target=_fill, args=(str(tmp_path), out)) for _ in range(3)]
    for w in workers:
        w.start()
    results = [out.get(timeout=120) for _ in workers]
    for w in workers:
        w.join(30)
    assert results[0] == results[1] == results[2]
    names = [p.name for p in files(tmp_path)]
    assert names == [f"{k:06d}.jpeg" for k in range(9)]
