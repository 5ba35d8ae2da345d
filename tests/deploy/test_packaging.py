"""What a fresh clone rests on: the Makefile's wiring, and bounds that fit the generated code."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tests.conftest import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GENERATED = ROOT / "proto" / "freshfield" / "v1"


def requirement(name: str) -> Requirement:
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    return next(r for r in map(Requirement, itertools.chain(*groups)) if r.name == name)


def lower_bound(name: str) -> Version:
    return max(Version(s.version) for s in requirement(name).specifier if s.operator in (">=", "=="))


def versions(pattern: str, files: str) -> set[Version]:
    found = {Version(v) for f in GENERATED.glob(files) for v in re.findall(pattern, f.read_text())}
    assert found, f"no version found in {files}: has the generator changed its header?"
    return found


def test_installing_the_oldest_allowed_grpcio_satisfies_the_generated_code() -> None:
    (generated,) = versions(r"GRPC_GENERATED_VERSION = '(.*)'", "*_pb2_grpc.py")
    for name in ("grpcio", "grpcio-health-checking", "grpcio-reflection"):
        assert lower_bound(name) >= generated
    assert lower_bound("grpcio-tools") == generated, "make proto-check needs the version that generated"


def test_installing_the_oldest_allowed_protobuf_satisfies_the_generated_code() -> None:
    (generated,) = versions(r"# Protobuf Python Version: (.*)", "*_pb2.py")
    assert lower_bound("protobuf") >= generated


def test_cameras_and_emulator_install_without_torch() -> None:
    required = {Requirement(r).name for r in PROJECT["dependencies"]}
    assert not required & {"torch", "viser", "numba", "matplotlib"}


def dry_run(*arguments: str, **variables: str) -> str:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    command = ["make", "-n", "-B", *arguments, *(f"{k}={v}" for k, v in variables.items())]
    # Not the variables of the make that runs this test.
    plain = {name: os.environ[name] for name in ("PATH", "HOME") if name in os.environ}
    done = subprocess.run(
        command, cwd=ROOT, env=plain, capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout


def test_a_fresh_clone_installs_torch_first_and_the_demo_without_test_tools() -> None:
    plan = dry_run("demo")
    (torch,) = re.finditer(r"install .*--no-deps +(torch==\S+)", plan)
    rest = plan.index("-e '.[edge,embed,up]'")
    assert plan.index("-m venv .venv") < torch.start() < rest < plan.index("deploy/up.py")
    assert "deploy/up.py deploy/scenarios/card.yaml --for 60s" in plan
    assert requirement("torch").specifier == Requirement(torch[1]).specifier
    for early in re.findall(r"install .*'(numba\S+)' '(opencv\S+)'", plan)[0]:
        assert requirement(Requirement(early).name).specifier == Requirement(early).specifier
    assert "test,dev" not in plan


def test_the_index_variable_reaches_torch_alone() -> None:
    plan = dry_run("demo", TORCH_INDEX="file:///some/index")
    assert plan.count("--index-url file:///some/index") == 1
    assert "--index-url file:///some/index torch==" in plan


def test_the_options_of_the_demo_reach_the_launcher() -> None:
    plan = dry_run("demo", SCENARIO="s.yaml", FOR="5s", OUT="o", PORT="8181", DATA="d")
    assert "deploy/up.py s.yaml --for 5s --out o --port 8181 --data d" in plan


def test_no_package_index_is_written_down() -> None:
    files = ["Makefile", "pyproject.toml", ".ci/run", "deploy/camera.Dockerfile", "deploy/edge.Dockerfile"]
    for name in files:
        assert "://" not in (ROOT / name).read_text(), f"{name} names a host"


def test_a_second_set_up_has_nothing_to_do() -> None:
    stamps = [ROOT / ".venv" / name for name in (".ok-venv", ".ok-test", ".ok-run")]
    newest = (ROOT / "pyproject.toml").stat().st_mtime
    if not all(s.exists() and s.stat().st_mtime >= newest for s in stamps):
        pytest.skip("this environment was not made by `make test`")
    done = subprocess.run(["make", "-q", ".venv/.ok-test", ".venv/.ok-run"], cwd=ROOT, timeout=60)
    assert done.returncode == 0
