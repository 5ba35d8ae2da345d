from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import adaptive_avg_pool2d

from edge_server.cli import main as edge_server
from edge_server.fidelity import fetch_lpips, lpips_network
from edge_server.fidelity.fetch_lpips import FetchError, convert
from edge_server.fidelity.images import ImageError
from edge_server.fidelity.lpips_weights import FILES, FOLDER_VARIABLE, open_lpips, weights_folder
from tests.conftest import data_dir

# Values published with the weights: (reference, p0) and (reference, p1) of the authors' example images.
GOLDEN = (0.7219, 0.1376)


def metric():
    lpips, reason = open_lpips(data_dir("lpips"))
    assert lpips is not None, reason
    return lpips


def example(name):
    return cv2.imread(str(data_dir("lpips") / f"ex_{name}.png"))[..., ::-1]


def test_golden_values():
    lpips = metric()
    first, second = GOLDEN
    assert lpips(example("p0"), example("ref")) == pytest.approx(first, abs=1e-4)
    assert lpips(example("p1"), example("ref")) == pytest.approx(second, abs=1e-4)
    assert lpips(example("ref"), example("ref")) == 0.0
    assert lpips.minimum_side == 31
    with pytest.raises(ImageError, match=r"LPIPS needs .* 31 x 31"):
        lpips(np.zeros((30, 64, 3)), np.ones((30, 64, 3)))


def test_a_mask_blackens_the_rest_and_weighs_each_cell_of_a_slice_by_its_share():
    lpips = metric()
    a, b = np.random.default_rng(3).random((2, 64, 96, 3))
    mask = np.ones((64, 96), bool)
    mask[:, 70:] = mask[50:, :10] = False
    distance, black = lpips(a, b, mask), (a * mask[..., None], b * mask[..., None])
    assert distance == lpips(*black, mask) != pytest.approx(lpips(*black), rel=0.01)
    assert lpips(a, b, np.ones_like(mask)) == pytest.approx(lpips(a, b), abs=1e-12)
    parameters, expected = {name: torch.from_numpy(array) for name, array in lpips._parameters.items()}, 0.0
    x = torch.from_numpy(np.stack(black).astype(np.float32).transpose(0, 3, 1, 2)) * 2 - 1
    x = (x - torch.tensor(lpips_network.SHIFT).view(3, 1, 1)) / torch.tensor(lpips_network.SCALE).view(3, 1, 1)
    for found, weights in zip(lpips_network._slices(parameters, x), lpips._lin):
        unit = (found / found.norm(dim=1, keepdim=True).clamp_min(1e-9)).double().numpy()
        map_ = ((unit[0] - unit[1]) ** 2 * weights[:, None, None]).sum(0)
        share = adaptive_avg_pool2d(torch.from_numpy(mask.astype(float))[None], map_.shape)[0].numpy()
        expected += np.average(map_, weights=share)
    assert distance == pytest.approx(expected, rel=1e-4)


def test_the_weights_folder_is_the_nearest_that_was_named(tmp_path, monkeypatch):
    data, named = tmp_path / "data", tmp_path / "named"
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    lpips, reason = open_lpips()
    assert lpips is None and "--lpips" in reason and FOLDER_VARIABLE in reason
    assert weights_folder() is None and weights_folder(None, data) is None
    (data / "lpips").mkdir(parents=True)
    assert weights_folder(None, data) == data / "lpips"
    monkeypatch.setenv("FRESHFIELD_DATA", str(data))
    assert weights_folder() == data / "lpips"
    monkeypatch.setenv(FOLDER_VARIABLE, str(named))
    assert weights_folder(None, data) == named and weights_folder(tmp_path, data) == tmp_path


def test_torn_and_wrong_weights_give_a_reason_and_no_metric(tmp_path):
    source = data_dir("lpips")
    features, lin = FILES
    (tmp_path / lin).write_bytes((source / lin).read_bytes())
    (tmp_path / features).write_bytes((source / features).read_bytes()[:100_000])
    lpips, reason = open_lpips(tmp_path)
    assert lpips is None and "cannot be used" in reason
    (tmp_path / features).write_bytes((source / features).read_bytes())
    np.savez(tmp_path / lin, lin0=np.ones(64, np.float32))
    lpips, reason = open_lpips(tmp_path)
    assert lpips is None and "[64]" in reason and "[64, 192, 384, 256, 256]" in reason


def test_it_computes_with_one_thread_whatever_torch_may_use(monkeypatch):
    """Two that spin for each other take forty times as long on a busy machine, and may round otherwise."""
    used, conv2d, before = [], lpips_network.F.conv2d, torch.get_num_threads()

    def noted(*args):
        used.append(torch.get_num_threads())
        return conv2d(*args)

    monkeypatch.setattr(lpips_network.F, "conv2d", noted)
    torch.set_num_threads(2)
    try:
        metric()(example("p0"), example("ref"))
        assert set(used) == {1} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# (name, (out, in, kernel)) of torchvision's convolutions.
ALEX = (("0", (64, 3, 11)), ("3", (192, 64, 5)), ("6", (384, 192, 3)), ("8", (256, 384, 3)), ("10", (256, 256, 3)))
ALEX_LINS = (64, 192, 384, 256, 256)


def random_weights():
    """State dictionaries of the right shapes."""
    torch.manual_seed(0)
    features = {}
    for name, (c_out, c_in, kernel) in ALEX:
        features[f"{name}.weight"] = torch.randn(c_out, c_in, kernel, kernel) * 0.05
        features[f"{name}.bias"] = torch.randn(c_out) * 0.05
    return features, {f"lin{k}.model.1.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(ALEX_LINS)}


def test_the_command_says_where_it_wrote_what_it_fetched_or_what_is_wrong(tmp_path, monkeypatch, capsys):
    features, lins = random_weights()
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
    (kept, lin) = (np.load(tmp_path / name) for name in FILES)
    np.testing.assert_array_equal(kept["features.8.bias"], features["8.bias"].numpy())
    np.testing.assert_array_equal(lin["lin3"].ravel(), lins["lin3.model.1.weight"].numpy().ravel())
