"""What an installation rests on: locks that hold what is asked for, bounds that fit the generated code, and a wheel
that does what a checkout does."""

import contextlib
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.conftest import ROOT
from tests.support import free_port

DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, BUILD = DECLARED["project"], DECLARED["build-system"]["requires"]
LOCKS = {
    file.stem: dict(re.findall(r"^([\w.-]+)={2,3}(\S+)", file.read_text(), re.M))
    for file in (ROOT / "deploy" / "locks").glob("*.txt")
}
GENERATED = ROOT / "proto" / "freshfield" / "v1"


def lower_bound(name: str) -> Version:
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    asked = next(each for group in groups for each in map(Requirement, group) if each.name == name)
    return max(Version(s.version) for s in asked.specifier if s.operator in (">=", "=="))


def generator(pattern: str, files: str) -> Version:
    """Of what the generated files say that they were made with."""
    (found,) = {Version(v) for f in GENERATED.glob(files) for v in re.findall(pattern, f.read_text())}
    return found


def test_installing_the_oldest_allowed_versions_satisfies_the_generated_code():
    grpc = generator(r"GRPC_GENERATED_VERSION = '(.*)'", "*_pb2_grpc.py")
    for name in ("grpcio", "grpcio-health-checking", "grpcio-reflection"):
        assert lower_bound(name) >= grpc
    assert lower_bound("grpcio-tools") == grpc, "make proto-check needs the version that generated"
    assert lower_bound("protobuf") >= generator(r"# Protobuf Python Version: (.*)", "*_pb2.py")


@pytest.mark.parametrize("locks", [("camera",), ("edge", "torch-cpu"), ("edge", "torch-cuda")])
def test_an_image_installs_all_that_the_project_and_its_packages_ask_for(locks):
    locked = {name: Version(version) for lock in locks for name, version in LOCKS[lock].items()}
    for lock in locks:  # a package in two of them has one version
        assert LOCKS[lock].items() <= {name: str(version) for name, version in locked.items()}.items()
    extras = PROJECT["optional-dependencies"]
    asked = PROJECT["dependencies"] + (extras["edge"] + extras["embed"] if "edge" in locks else [])
    for name, version in locked.items():  # and what those ask for, as far as this machine has the same ones
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            if Version(importlib.metadata.version(name)) == version:
                asked = asked + (importlib.metadata.requires(name) or [])
    image = {"python_version": "3.11", "sys_platform": "linux", "platform_system": "Linux", "extra": ""}
    for each in map(Requirement, asked):
        if each.marker is not None and not each.marker.evaluate(image):
            continue
        version = locked.get(canonicalize_name(each.name))
        assert version is not None and each.specifier.contains(version), f"{each}: {version} is locked"
    if "edge" in locks:
        assert str(locked["torch"]).partition("+")[0] == "2.13.0"  # with which checkpoints and figures were made
        assert LOCKS["camera"].items() <= LOCKS["edge"].items()
    assert ("torch" in locked) == ("edge" in locks)


@pytest.mark.parametrize(
    ("image", "locks"), [("camera", {"build", "camera"}), ("edge", {"build", "edge", "torch-$TORCH"})]
)
def test_an_image_installs_locked_wheels_and_the_project_alone(image, locks):
    text = (ROOT / "deploy" / f"{image}.Dockerfile").read_text().replace("\\\n", " ")
    installs = re.findall(r"pip install ([^\n&]*)", text)
    assert len(installs) == 3 and all("--no-deps" in words for words in installs)
    assert all(("--require-hashes" in words) != ("--no-index /dist/" in words) for words in installs)
    assert set(re.findall(r"-r deploy/locks/(\S+)\.txt", text)) == locks
    assert {Requirement(text).name for text in BUILD} <= LOCKS["build"].keys()
    assert "!deploy/locks" in (ROOT / ".dockerignore").read_text().splitlines()


def installed(home: Path) -> tuple[Path, Path]:
    """The project's wheel, and the bin folder of a new environment that holds it and sees this one's third-party
    packages."""
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(home), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (wheel,) = home.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", str(home)], check=True, timeout=120)
    (site,) = (home / "lib").glob("python*/site-packages")
    # A .pth file in a folder named by a .pth file is not read: the checkout itself stays out of sight.
    here = [path for path in sys.path if path.endswith("site-packages")]
    (site / "third-party.pth").write_text("\n".join(here))
    install = [str(home / "bin/python"), "-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    return wheel, home / "bin"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_wheel_carries_scenarios_and_models_and_its_launcher_runs_one_by_name(tmp_path):
    wheel, programs = installed(tmp_path / "venv")
    names = set(zipfile.ZipFile(wheel).namelist())
    scenarios = ROOT / "deploy/scenarios"
    shipped = {f"freshfield/scenarios/{path.relative_to(scenarios)}" for path in scenarios.rglob("*.*")}
    folders = [ROOT / f"edge_server/{room}/models" for room in ("embed", "foreground")]
    assert shipped | {str(path.relative_to(ROOT)) for folder in folders for path in folder.iterdir()} <= names
    assert not [name for name in names if name.startswith(("tests/", "deploy/", "docs/"))]
    words = ["demo", "quad", "--for", "5s", "--out", "runs/up", "--port", str(free_port())]
    command = [str(programs / "freshfield"), *words]
    there = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run(command, cwd=tmp_path, env=there, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "runs/up/report.json").read_text())
    assert report["frames"]["closes"] and report["frames"]["delivered"] > 0
