"""``edge-server export`` on what real fields leave behind, and what it says where it cannot."""

from __future__ import annotations

import sys
import tracemalloc
import zipfile

import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.export import ExportError
from edge_server.export.run_source import open_source
from tests.edge_server.export.learned import saved


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    saved(folder)
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


def test_a_field_comes_back_as_it_was(tmp_path):
    field = saved(tmp_path, steps=2)
    source = open_source(tmp_path)
    assert source.name == "splat" and len(source.views) == 8
    view = source.views[0]
    before, after = (f.render(view.camera_to_world, view.intrinsics) for f in (field, source.field))
    np.testing.assert_array_equal(before.color, after.color)
    np.testing.assert_array_equal(before.depth, after.depth)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--mesh", "m.obj"), "--mesh m.obj: expected a file that ends in .ply or .glb"),
        (("--mesh", "m.ply", "--voxel", "0"), "--voxel 0: expected more than 0 mm"),
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
    with pytest.raises(SystemExit):
        export(run)
    assert "say what to write" in capsys.readouterr().err


def test_what_is_missing_is_said(tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "skimage.measure", None)  # as where it is not installed
        assert export(tmp_path / "nowhere", "--mesh", tmp_path / "m.ply") == 2
    assert "pip install 'freshfield[surface]'" in capsys.readouterr().err
    assert export(tmp_path / "nowhere", "--points", tmp_path / "p.ply") == 2
    assert "no such file or folder" in capsys.readouterr().err
    assert export(tmp_path, "--points", tmp_path / "p.ply") == 2
    assert "holds no checkpoint" in capsys.readouterr().err
    (tmp_path / "field.npz").write_bytes(b"half of it")
    assert export(tmp_path, "--points", tmp_path / "p.ply") == 2
    assert "damaged or not a checkpoint" in capsys.readouterr().err
    saved(tmp_path, "ngp", {"rays": 512, "batch_samples": 4096, "samples": 48}, steps=2)
    assert export(tmp_path, "--splats", tmp_path / "s.ply") == 2
    assert "ngp has no Gaussians" in capsys.readouterr().err


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
