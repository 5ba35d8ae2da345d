"""The template of a plug-in, built and installed outside the repository, is used by its entry points' names."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.conftest import ROOT
from tests.edge_server.experiments.rollouts.small import RAW

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def run(words: list[str], cwd: Path, *path: Path) -> str:
    here = [str(each) for each in (*path, ROOT / "proto", ROOT, ROOT / "deploy")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(here)}
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_template_is_built_installed_checked_and_used(tmp_path: Path) -> None:
    source, wheels, site = tmp_path / "plugin", tmp_path / "wheels", tmp_path / "site"
    shutil.copytree(ROOT / "examples/plugin", source)
    run(["pip", "wheel", "-q", "--no-deps", "-w", str(wheels), str(source)], tmp_path)
    (wheel,) = wheels.iterdir()
    run(["pip", "install", "-q", "--no-deps", "--no-index", "--target", str(site), str(wheel)], tmp_path)
    (source / "freshfield_example.py").unlink()  # the installed one is meant

    assert "4 passed" in run(["pytest", "-q", "test_contract.py"], source, site)
    edge = {**RAW["edge"], "policy": {"name": "least-used", "value": 1}}
    whole = {**RAW, "edge": edge, "source": {**RAW["source"], "effects": {"vignette": {"loss": 0.3}}}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(whole))
    said = run(["edge_server.cli", "simulate", "mine.yaml", "--seconds", "1", "--json"], tmp_path, site)
    assert json.loads(said)["policy"] == "least-used"
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**whole, "source": {"kind": "bar", "bar_px": 4}}))
    said = run(["edge_server.cli", "simulate", "mine.yaml", "--seconds", "1", "--json"], tmp_path, site)
    assert json.loads(said)["updates"] > 0
