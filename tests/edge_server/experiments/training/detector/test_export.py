"""What is exported computes what was trained, is a detector like any other, and carries its projection."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from edge_server.embed import EmbeddingConfig, make_embedder
from edge_server.experiments.training.detector.export import add_projection, export_onnx, pooled_features, runner
from edge_server.experiments.training.detector.network import Detector
from edge_server.experiments.training.detector.scenes import KINDS

IMAGES = np.random.default_rng(0).integers(0, 256, (24, 64, 64, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """(model, file with its projection) of an untrained detector."""
    folder = tmp_path_factory.mktemp("detector")
    torch.manual_seed(3)
    model = Detector(len(KINDS))
    with torch.no_grad():  # give normalisation something to fold
        model.train()(torch.rand(8, 3, 64, 64))
    export_onnx(model.eval(), 64, folder / "fp32.onnx", {"author": "test"})
    share = add_projection(folder / "fp32.onnx", pooled_features(folder / "fp32.onnx", IMAGES))
    assert list(share.values()) == sorted(share.values()) and max(share.values()) <= 1.0
    return model, folder / "fp32.onnx"


@pytest.mark.parametrize("shape", [(1, 64, 64), (3, 48, 96)])
def test_float_is_what_torch_computes_at_any_size(exported, shape):
    model, fp32 = exported
    n, height, width = shape
    x = torch.rand(n, 3, height, width)
    with torch.no_grad():
        true = model(x).numpy()
    assert runner(fp32)(x.numpy()) == pytest.approx(true, abs=1e-3)


def test_the_learnt_projection_gives_unit_variance_without_mean(exported):
    _, fp32 = exported
    made = make_embedder(EmbeddingConfig(str(fp32), 8, provider="cpu"))
    rows = made.embed(list(IMAGES))
    assert made.backbone.height == 64, "as the metadata says"
    assert rows.mean(axis=0) == pytest.approx(np.zeros(8), abs=1e-2)
    assert (rows**2).mean(axis=0) == pytest.approx(np.ones(8), abs=1e-2)


def test_fewer_numbers_are_the_first_of_more(exported):
    _, fp32 = exported
    few, many = (make_embedder(EmbeddingConfig(str(fp32), d, provider="cpu")).embed(list(IMAGES[:3])) for d in (4, 12))
    assert many[:, :4] == pytest.approx(few, abs=1e-4)
