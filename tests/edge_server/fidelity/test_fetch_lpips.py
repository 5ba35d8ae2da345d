"""The public package's weights become our weights folder; the download itself is torchvision's."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from edge_server.cli import main as edge_server
from edge_server.fidelity import fetch_lpips
from edge_server.fidelity.fetch_lpips import FetchError, convert
from edge_server.fidelity.lpips_weights import FILES, open_lpips

# (name, (out, in, kernel)) of torchvision's convolutions.
ALEX = (("0", (64, 3, 11)), ("3", (192, 64, 5)), ("6", (384, 192, 3)), ("8", (256, 384, 3)), ("10", (256, 256, 3)))
ALEX_LINS = (64, 192, 384, 256, 256)


def random_weights(convolutions, lins):
    """State dictionaries of the right shapes."""
    torch.manual_seed(0)
    features = {}
    for name, (c_out, c_in, kernel) in convolutions:
        features[f"{name}.weight"] = torch.randn(c_out, c_in, kernel, kernel) * 0.05
        features[f"{name}.bias"] = torch.randn(c_out) * 0.05
    return features, {f"lin{k}.model.1.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(lins)}


def test_alex_is_what_its_layers_compute(tmp_path):
    """Against the network built of torch's own modules."""
    features, lins = random_weights(ALEX, ALEX_LINS)
    convert(features, lins, tmp_path)
    metric, _ = open_lpips(tmp_path)
    conv = {n: torch.nn.Conv2d(i, o, k, 4 if k == 11 else 1, {11: 2, 5: 2, 3: 1}[k]) for n, (o, i, k) in ALEX}
    for name, module in conv.items():
        module.load_state_dict({key: features[f"{name}.{key}"] for key in ("weight", "bias")})
    rng = np.random.default_rng(2)
    a, b = rng.random((2, 64, 64, 3))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = torch.from_numpy(np.stack([a, b])).float() * 2 - 1
    x = ((x - shift) / scale).permute(0, 3, 1, 2)
    total = 0.0
    with torch.no_grad():
        for k, name in enumerate(conv):
            x = torch.relu(conv[name](torch.nn.functional.max_pool2d(x, 3, 2) if k in (1, 2) else x))
            unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
            total += float((lins[f"lin{k}.model.1.weight"] * (unit[:1] - unit[1:]) ** 2).sum(1).mean())
    assert metric(a, b) == pytest.approx(total, rel=1e-4) and metric(a, a) == 0.0


def test_the_command_says_where_it_wrote_what_it_fetched_or_what_is_wrong(tmp_path, monkeypatch, capsys):
    features, lins = random_weights(ALEX, ALEX_LINS)
    with pytest.raises(FetchError, match="cannot be used"):
        convert({k: v for k, v in features.items() if k != "3.bias"}, lins, tmp_path)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "lpips", None)
        assert edge_server(["fetch-lpips", "--out", str(tmp_path)]) == 2
        assert "needs lpips: pip install 'freshfield[edge,lpips]'" in capsys.readouterr().err
    monkeypatch.setattr(fetch_lpips, "_fetch", lambda: (features, lins))
    assert edge_server(["fetch-lpips", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in FILES]
    assert open_lpips(tmp_path)[1] is None
