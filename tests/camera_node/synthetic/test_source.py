"""Cameras of the world and their frames on disk: right, found again, shared, and rendered again when damaged."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from camera_node.synthetic import frame_cache, make_scene
from camera_node.synthetic import source as source_module
from camera_node.synthetic.effects import load_effects
from camera_node.synthetic.frame_cache import default_folder, prune
from camera_node.synthetic.source import WorldSource
from freshfield import payload
from freshfield.scenario import ScenarioError, parse

SMALL = {"width": 32, "height": 32, "supersample": 1, "speed_m_per_s": 8.0}  # 0.6 s: few frames


@pytest.mark.parametrize(
    ("ids", "taken"),
    [
        (["cam02", "cam01"], ["cam02", "cam01"]),
        (["cam02", "eye"], ["cam00", "cam01"]),
        (["left", "right"], ["cam00", "cam01"]),
        ([f"c{k}" for k in range(4)], None),
    ],
)
def test_cameras_are_those_of_the_scene_by_name_if_it_has_all_of_them_or_else_in_order(ids, taken):
    scenario = parse({"cameras": {"ids": ids}}, Path("own.yaml"))
    if taken is None:
        with pytest.raises(ScenarioError, match=r"own\.yaml: cameras: the scene has 3: cam00, cam01, cam02"):
            source_module._scene_cameras(scenario, room(count=3))
    else:
        assert source_module._scene_cameras(scenario, room(count=3)) == dict(zip(ids, taken))


def room(**changes):
    return make_scene("room", {**SMALL, **changes})


def source(scene=None, fps=15, camera="cam01", **options) -> WorldSource:
    return WorldSource("eye", scene or room(), camera, fps, **options)


def effects(**listed):
    return load_effects(listed, lambda name: np.random.default_rng(5))


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def shown(made: WorldSource, count: int = 9) -> list:
    return [made.read(k).image for k in range(count)]


@pytest.mark.parametrize(
    ("fps", "frames"), [(15, 9), (Fraction(100, 3), 20), (30.0, 18), (24, 72), (25, 15), (29.97, 8991)]
)
def test_the_sequence_repeats_after_whole_periods(fps, frames):
    """Frame numbers count to the first common multiple of period and frame time (29.97: too long)."""
    made = source(fps=fps)
    expected = frames if frames <= source_module.MAX_FRAMES else None
    assert made.repeats_after == made.contents == expected
    if expected:
        assert (Fraction(expected) / made.fps / Fraction(6, 10)).denominator == 1


def test_a_frame_is_the_scene_at_its_instant_for_ever(tmp_path):
    scene = room()
    made = source(scene, folder=tmp_path)
    for tick in (0, 1, 8, 9, 10, 9 * 10**12 + 4):
        expected = payload.encode(scene.render("cam01", (tick % 9) / 15), "jpeg", 92)
        assert made.read(made.content(tick)).image == made.read(tick).image == expected


def test_a_static_scene_is_one_frame(tmp_path):
    made = source(make_scene("tile", {"width": 32, "height": 32}), folder=tmp_path)
    assert made.contents == 1 and made.content(123) == 0
    assert made.read(7).image == made.read(0).image
    assert len(files(tmp_path)) == 1


@pytest.mark.parametrize("codec", payload.CODECS)
def test_prepared_once_nothing_is_rendered_again(tmp_path, codec, monkeypatch):
    first = source(codec=codec, folder=tmp_path)
    assert shown(first, 1) and len(files(tmp_path)) == 1, "frames can be read before they are all there"
    first.prepare(lambda: len(files(tmp_path)) >= 3)
    assert len(files(tmp_path)) == 3
    first.prepare(lambda: False)
    assert len(files(tmp_path)) == 9
    again = source(codec=codec, folder=tmp_path)
    monkeypatch.setattr(again, "_render", None)
    again.prepare(lambda: False)
    assert shown(again) == shown(first)


@pytest.mark.parametrize("damage", [b"", b"rubbish", b"\xff\xd8\xff\xe0" * 200])
def test_a_damaged_entry_is_rendered_again(tmp_path, damage):
    good = source(folder=tmp_path)
    good.prepare(lambda: False)
    victim = files(tmp_path)[3]
    whole = victim.read_bytes()
    victim.write_bytes(damage)
    assert source(folder=tmp_path).read(3).image == whole == victim.read_bytes()


def test_the_key_follows_all_that_decides_the_bytes(monkeypatch):
    base = source().key()
    assert source(fps=15.0).key() == source(room(count=5)).key() == base
    others = [
        source(camera="cam02"),
        source(fps=30),
        source(codec="png"),
        source(quality=80),
        source(phase_ns=1),
        source(room(speed_m_per_s=4.0)),
        source(room(supersample=2)),
        source(room(horizontal_fov_deg=50.0)),
    ]
    keys = [made.key() for made in others]
    assert len({base, *keys}) == len(keys) + 1
    monkeypatch.setattr(source_module, "renderer_version", lambda: "another renderer")
    assert source().key() != base


def test_noise_is_added_to_lossless_frames_and_never_repeats(tmp_path):
    scene = room()
    made = source(scene, effects=effects(sensor_noise={}), folder=tmp_path)
    assert made.contents is None and made.content(1234) == 1234
    exact = scene.render("cam01", 2 / 15)
    a, b = made.read(2).image, made.read(2 + 9).image
    assert np.array_equal(made.image(2), exact) and len(files(tmp_path)) == 1
    assert isinstance(a, np.ndarray) and not np.array_equal(a, b)
    assert np.abs(a.astype(int) - exact).mean() < 6
    assert np.array_equal(source(scene, effects=effects(sensor_noise={})).read(2).image, a)


def test_what_does_not_repeat_is_rendered_as_it_goes(tmp_path):
    made = source(fps=29.97, folder=tmp_path)
    made.prepare(lambda: False)
    t = float(Fraction(1000) / Fraction(2997, 100))
    assert made.content(10**6) == 10**6
    assert made.read(1000).image == payload.encode(room().render("cam01", t), "jpeg", 92)
    assert files(tmp_path) == []


def test_a_folder_that_cannot_be_written_costs_time_not_frames(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    made = source(folder=blocked)
    expected = payload.encode(room().render("cam01", 3 / 15), "jpeg", 92)
    assert made.read(3).image == expected and "file" in made.cache.error
    made.prepare(lambda: False)
    assert made.read(3).image == expected


def test_default_folder_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "freshfield" / "frames"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_folder() == tmp_path / "home" / ".cache" / "freshfield" / "frames"


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
