"""``edge-server export`` on what real fields leave behind, and what it says where it cannot."""

from __future__ import annotations

import re
import sys
import tracemalloc
import zipfile

import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.export import ExportError
from edge_server.export.run_source import open_source
from edge_server.fields import Budget, checkpoint
from edge_server.fields.registry import make_field
from edge_server.surface import reconstruct

OPTIONS = {"splat": {"gaussians": 512, "start": 256, "seed_cells": 16}}
SMALL = {"rays": 512, "batch_samples": 4096, "samples": 48}


def saved(folder, name: str, steps: int = 30):
    """A checkpoint of a field that has learned ``tile`` a little, as a run leaves it."""
    options = OPTIONS.get(name, SMALL)
    field = make_field(name, options, seed=3)
    field.fit(synthetic_still("tile", cameras=9, size=32).training, Budget(steps=steps))
    checkpoint.save(folder / "field.npz", field.state(), {"field": name, "options": {}, "seed": 3})
    return field


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    saved(folder, "splat", steps=60)
    return folder


def export(*words) -> int:
    return edge_server(["export", *map(str, words)])


def test_everything_at_once(run, tmp_path, capsys):
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    written = {"mesh": "m.ply", "splats": "s.ply", "points": "p.ply", "colmap": "colmap", "transforms": "nerf"}
    words = [word for option, name in written.items() for word in (f"--{option}", tmp_path / name)]
    status = export(run, *words, "--voxel", 10, "--count", 500)
    said = capsys.readouterr().out
    assert status == 0, said
    for name in ("m.ply", "s.ply", "p.ply", "colmap/sparse/0/images.txt", "nerf/transforms.json"):
        assert (tmp_path / name).stat().st_size > 100, name
    assert len(list((tmp_path / "colmap" / "images").glob("*.png"))) == 8
    assert "8 cameras" in said and "triangles" in said
    assert "%" not in said.replace("% of", "")  # progress is for terminals


def test_depth_is_sharpened_for_a_mesh_alone(run, tmp_path, monkeypatch):
    """It takes minutes; progress is one line of a terminal."""
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    sharpened, sharpen = [], reconstruct.refine_depth
    monkeypatch.setattr(reconstruct, "refine_depth", lambda *args: sharpened.append(1) or sharpen(*args))
    assert export(run, "--points", tmp_path / "p.ply", "--colmap", tmp_path / "colmap") == 0 and not sharpened
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    written = []
    monkeypatch.setattr(sys.stderr, "write", written.append, raising=False)
    assert export(run, "--mesh", tmp_path / "m.ply", "--voxel", 10) == 0 and sharpened
    assert any(text.startswith("\r  sharpen") for text in written)


def test_points_of_large_pictures_are_drawn_from_a_part_of_them(run, tmp_path, capsys, monkeypatch):
    """Of 8 x 32 x 32 pixels."""
    sizes, rendered = [], reconstruct.render_depth_maps
    monkeypatch.setattr(
        reconstruct,
        "render_depth_maps",
        lambda f, cameras, *more: sizes.append([lens.width for _, lens in cameras]) or rendered(f, cameras, *more),
    )
    for count, width in ((2, 32 * (2000 / (8 * 32 * 32)) ** 0.5), (80, 32)):
        assert export(run, "--points", tmp_path / "p.ply", "--count", count) == 0
        assert sizes.pop() == [pytest.approx(width, abs=1)] * 8
        assert " points" in capsys.readouterr().out


def test_a_mesh_is_written(run, tmp_path, capsys):
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    assert export(run, "--mesh", tmp_path / "m.ply", "--voxel", 10, "--no-sharpen") == 0
    said = capsys.readouterr().out
    assert int(re.search(r"m.ply: (\d+) triangles", said)[1]) > 10 and "8 cameras" in said


@pytest.mark.parametrize("name", ["splat", "ngp"])  # nerfacto and tensorf are written as ngp is
def test_a_field_comes_back_as_it_was(tmp_path, name):
    field = saved(tmp_path, name, steps=2)
    source = open_source(tmp_path)
    assert source.name == name and len(source.views) == 8
    view = source.views[0]
    before, after = (f.render(view.camera_to_world, view.intrinsics) for f in (field, source.field))
    np.testing.assert_array_equal(before.color, after.color)
    np.testing.assert_array_equal(before.depth, after.depth)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--mesh", "m.obj"), "--mesh m.obj: expected a file that ends in .ply or .glb"),
        (("--mesh", "m.ply", "--voxel", "0"), "--voxel 0: expected more than 0 mm"),
        (("--mesh", "m.ply", "--method", "poisson"), "method must be one of tsdf, sdf"),
        (("--points", "p.ply", "--count", "0"), "--count 0"),
        (("--splats", "s.splat"), "--splats s.splat: expected a file that ends in .ply or .spz"),
        (("--mesh", "m.ply", "--voxel", "10", "--bounds", *["1", "1", "1", "0", "0", "0"]), "lower corner"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(run, tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    assert export(run, *words) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_what_a_mesh_needs_is_asked_for_before_the_run_is_opened(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)  # as where it is not installed
    assert export(tmp_path / "nowhere", "--mesh", tmp_path / "m.ply") == 2
    assert "pip install 'freshfield[surface]'" in capsys.readouterr().err


def test_no_checkpoint_and_the_wrong_field(tmp_path, capsys):
    assert export(tmp_path / "nowhere", "--points", tmp_path / "p.ply") == 2
    assert "no such file or folder" in capsys.readouterr().err
    assert export(tmp_path, "--points", tmp_path / "p.ply") == 2
    assert "holds no checkpoint" in capsys.readouterr().err
    (tmp_path / "field.npz").write_bytes(b"half of it")
    assert export(tmp_path, "--points", tmp_path / "p.ply") == 2
    assert "damaged or not a checkpoint" in capsys.readouterr().err
    saved(tmp_path, "ngp", steps=2)
    assert export(tmp_path, "--splats", tmp_path / "s.ply") == 2
    assert "ngp has no Gaussians" in capsys.readouterr().err


def test_nothing_asked_for_is_an_error(run, capsys):
    with pytest.raises(SystemExit):
        export(run)
    assert "say what to write" in capsys.readouterr().err


def test_a_checkpoint_that_would_unpack_to_gigabytes_is_not_unpacked(tmp_path):
    """Ours are written without compression: none is larger than its file."""
    file = tmp_path / "field.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as entry:
        head = {"descr": "|u1", "fortran_order": False, "shape": (2**27,)}
        np.lib.format.write_array_header_1_0(entry, head)
        for _ in range(2**7):
            entry.write(bytes(2**20))
    tracemalloc.start()
    with pytest.raises(ExportError, match=r"field\.npz: unpacked it has 134\d+ bytes, which no field's"):
        open_source(file)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()
