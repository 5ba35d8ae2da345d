"""An installed wheel does what a checkout does: it is built, installed and run from an empty folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.support import free_port

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (found,) = folder.glob("*.whl")
    return found


def installed(wheel: Path, home: Path) -> Path:
    """The bin folder of a new environment that holds the wheel and sees this one's third-party packages."""
    subprocess.run([sys.executable, "-m", "venv", str(home)], check=True, timeout=120)
    python = home / "bin" / "python"
    (site,) = (home / "lib").glob("python*/site-packages")
    # A .pth file in a folder named by a .pth file is not read: the checkout itself stays out of sight.
    here = [path for path in sys.path if path.endswith("site-packages")]
    (site / "third-party.pth").write_text("\n".join(here))
    install = [str(python), "-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    return home / "bin"


def test_the_wheel_carries_scenarios_models_and_launcher(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    scenarios = ROOT / "deploy/scenarios"
    shipped = {f"freshfield/scenarios/{path.relative_to(scenarios)}" for path in scenarios.rglob("*.*")}
    folders = [ROOT / f"edge_server/{room}/models" for room in ("embed", "foreground")]
    models = {str(path.relative_to(ROOT)) for folder in folders for path in folder.iterdir()}
    assert shipped <= names and models <= names
    assert {"freshfield_up/cli.py", "edge_server/frontier.json"} <= names
    assert not [name for name in names if name.startswith(("tests/", "deploy/", "docs/"))]


def test_the_launcher_runs_a_shipped_scenario_by_name(wheel: Path, tmp_path: Path) -> None:
    words = ["demo", "quad", "--for", "5s", "--out", "runs/up", "--port", str(free_port())]
    command = [str(installed(wheel, tmp_path / "venv") / "freshfield"), *words]
    there = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run(command, cwd=tmp_path, env=there, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "runs/up/report.json").read_text())
    assert report["frames"]["closes"] and report["frames"]["delivered"] > 0
