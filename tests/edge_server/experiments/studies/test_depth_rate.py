"""The study of depth's rate: what a run sends and shows, and the line that it goes over."""

from __future__ import annotations

import pytest
import yaml

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.studies.depth_rate import DEPTH, EACH, NONE, SOME, DepthRun, run_with_depth
from edge_server.experiments.studies.study import judge
from freshfield.scenario import load


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    data = yaml.safe_load(load("quad").path.read_text())
    data["cameras"]["count"] = 3
    data["source"] |= {"width": 48, "height": 48}
    file = tmp_path_factory.mktemp("depth") / "small.yaml"
    file.write_text(yaml.safe_dump(data))
    return str(file)


def test_depth_is_sent_as_often_as_asked_for_and_takes_its_time_on_the_line(scene):
    runs = {every: DepthRun(scene, 1, every, 1.0, 1.2) for every in (NONE, SOME, EACH)}
    found = {every: run_with_depth(run, Folders(None, None)) for every, run in runs.items()}
    rates = [found[every]["kilobytes_per_s"] for every in (NONE, SOME, EACH)]
    assert (rates[1] - rates[0]) / (rates[2] - rates[0]) == pytest.approx(1 / 5, rel=0.1)
    assert found[EACH]["aaoi_ms"] > found[NONE]["aaoi_ms"]
    assert all(row["shown_psnr_db"] > 10.0 for row in found.values())


def test_a_claim_is_judged_on_each_line():
    rows = [
        {"scene": "quad", "line": line, "depth_every": every, "seed": seed, "shown_psnr_db": db + 0.01 * seed}
        for line in ("unbounded", "2 Mbit/s a camera")
        for every, db in ((NONE, 16.0), (SOME, 25.0), (EACH, 25.0 if line == "unbounded" else 23.0))
        for seed in range(4)
    ]
    said = {(v.about.split(", ")[1], v.claim.split(" is")[0]): v.verdict for v in judge(DEPTH, SeedTable(rows))}
    assert said["unbounded", "depth of each fifth frame"] == "holds"
    assert said["2 Mbit/s a camera", "depth of each frame"] == "does not hold"
