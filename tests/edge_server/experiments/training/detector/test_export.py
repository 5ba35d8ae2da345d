"""What is exported computes what was trained, is a detector like any other, and carries its projection."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from edge_server.embed import EmbeddingConfig, make_embedder
from edge_server.experiments.training.detector.export import (
    add_projection,
    export_fp32,
    export_int8,
    pooled_features,
    runner,
)
from edge_server.experiments.training.detector.network import Detector
from edge_server.experiments.training.detector.scenes import KINDS

IMAGES = np.random.default_rng(0).integers(0, 256, (24, 64, 64, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """(model, fp32 file with its projection, int8 file) of an untrained detector."""
    folder = tmp_path_factory.mktemp("detector")
    torch.manual_seed(3)
    model = Detector(len(KINDS))
    with torch.no_grad():  # give normalisation something to fold
        model.train()(torch.rand(8, 3, 64, 64))
    export_fp32(model.eval(), 64, folder / "fp32.onnx", {"author": "test"})
    share = add_projection(folder / "fp32.onnx", pooled_features(folder / "fp32.onnx", IMAGES))
    assert list(share.values()) == sorted(share.values()) and max(share.values()) <= 1.0
    export_int8(folder / "fp32.onnx", IMAGES, folder / "int8.onnx")
    return model, folder / "fp32.onnx", folder / "int8.onnx"


def test_masks_go_through_the_file_into_what_a_deployment_runs(tmp_path):
    from edge_server.foreground.detector import Detector as Deployed

    torch.manual_seed(4)
    model = Detector(1, 8)
    with torch.no_grad():
        model.train()(torch.rand(8, 3, 64, 64))
        model.model[10].score[1].bias.fill_(2.0)  # untrained, but sure
    export_fp32(model.eval(), 64, tmp_path / "fp32.onnx", {}, ("tile",))
    export_int8(tmp_path / "fp32.onnx", IMAGES, tmp_path / "int8.onnx")
    with torch.no_grad():
        table, maps = model(torch.from_numpy(IMAGES[:1].transpose(0, 3, 1, 2).astype(np.float32) / 255))
    for name, least in (("fp32", 0.999), ("int8", 0.9)):
        found = Deployed(str(tmp_path / f"{name}.onnx"))
        assert found.kinds == {0: "tile"} and (found.width, found.height) == (64, 64)
        best = found.detect(IMAGES[0], 0.25)[0]
        # Of the same cell, the mask that torch computes.
        size = torch.tensor([best.box[2] - best.box[0], best.box[3] - best.box[1]])
        centre = torch.tensor([best.box[0] + best.box[2], best.box[1] + best.box[3]]) / 2
        cell = (table[0, :4].T - torch.cat([centre, size])).abs().sum(1).argmin()
        logits = torch.einsum("m,mhw->hw", table[0, 5:, cell], maps[0])
        true = torch.nn.functional.interpolate(logits[None, None], (64, 64), mode="bilinear")[0, 0].numpy() > 0
        assert (best.mask() == true).mean() > least


@pytest.mark.parametrize("shape", [(1, 64, 64), (3, 48, 96)])
def test_float_is_what_torch_computes_at_any_size(exported, shape):
    model, fp32, _ = exported
    n, height, width = shape
    x = torch.rand(n, 3, height, width)
    with torch.no_grad():
        true = model(x).numpy()
    assert runner(fp32)(x.numpy()) == pytest.approx(true, abs=1e-3)


def test_eight_bits_are_near_and_smaller(exported):
    _, fp32, int8 = exported
    assert int8.stat().st_size < 0.5 * fp32.stat().st_size
    a, b = pooled_features(fp32, IMAGES), pooled_features(int8, IMAGES)
    assert np.abs(a - b).max() < 0.05 * np.abs(a).max()
    x = IMAGES[:2].transpose(0, 3, 1, 2).astype(np.float32) / 255
    full, small = runner(fp32)(x), runner(int8)(x)
    assert np.abs(full[:, :4] - small[:, :4]).max() < 2.0, "pixels"


def test_the_learnt_projection_gives_unit_variance_without_mean(exported):
    _, fp32, int8 = exported
    made = make_embedder(EmbeddingConfig(str(fp32), 8, provider="cpu"))
    rows = made.embed(list(IMAGES))
    assert made.backbone.height == 64, "as the metadata says"
    assert rows.mean(axis=0) == pytest.approx(np.zeros(8), abs=1e-2)
    assert (rows**2).mean(axis=0) == pytest.approx(np.ones(8), abs=1e-2)
    other = make_embedder(EmbeddingConfig(str(int8), 8, provider="cpu"))
    assert (other.backbone.projection.axes == made.backbone.projection.axes).all()


def test_fewer_numbers_are_the_first_of_more(exported):
    _, fp32, _ = exported
    few, many = (make_embedder(EmbeddingConfig(str(fp32), d, provider="cpu")).embed(list(IMAGES[:3])) for d in (4, 12))
    assert many[:, :4] == pytest.approx(few, abs=1e-4)
