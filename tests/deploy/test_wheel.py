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

BEYOND_THE_EMULATOR = ("cv2", "torch", "numba", "scipy", "viser", "jinja2", "onnxruntime")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (found,) = folder.glob("*.whl")
    return found


def installed(wheel: Path, home: Path, without: tuple[str, ...] = ()) -> Path:
    """The bin folder of a new environment that holds the wheel and sees this one's third-party packages, but some."""
    subprocess.run([sys.executable, "-m", "venv", str(home)], check=True, timeout=120)
    python = home / "bin" / "python"
    (site,) = (home / "lib").glob("python*/site-packages")
    # A .pth file in a folder named by a .pth file is not read: the checkout itself stays out of sight.
    here = [path for path in sys.path if path.endswith("site-packages")]
    blocked = f"import sys; sys.modules.update(dict.fromkeys({without}))"
    (site / "third-party.pth").write_text("\n".join([*here, blocked]))
    install = [str(python), "-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    return home / "bin"


def run(command: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    there = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    return subprocess.run(command, cwd=cwd, env=there, capture_output=True, text=True, timeout=120, check=False)


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
    done = run([str(installed(wheel, tmp_path / "venv") / "freshfield"), *words], tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "runs/up/report.json").read_text())
    assert report["frames"]["closes"] and report["frames"]["delivered"] > 0


def test_the_emulator_works_where_nothing_else_does(wheel: Path, tmp_path: Path) -> None:
    """``freshfield[emu]`` on a machine that cannot load what cameras and edge need besides."""
    programs = installed(wheel, tmp_path / "venv", without=BEYOND_THE_EMULATOR)
    emulator, python = str(programs / "channel-emu"), str(programs / "python")
    for words in (
        "simulate --preset ch5 --cameras 4 --seconds 60 --csv frames.csv",
        "fit frames.csv --plot fit.png --out fitted.yaml",
        "simulate --scenario fitted.yaml --cameras 4 --seconds 10",
    ):
        done = run([emulator, *words.split()], tmp_path)
        assert done.returncode == 0, words + done.stdout + done.stderr
    assert {"fit.png", "fitted.yaml"} <= {path.name for path in tmp_path.iterdir()}
    missing = run([python, "-c", "import camera_node.synthetic.render"], tmp_path)
    assert "import of cv2 halted" in missing.stderr, "OpenCV was within reach: nothing was tested"
