"""What a fresh clone rests on: the Makefile's wiring, and bounds that fit the generated code."""

from __future__ import annotations

import contextlib
import importlib.metadata
import itertools
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import lock
from tests.conftest import ROOT

DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, BUILD = DECLARED["project"], DECLARED["build-system"]["requires"]
LOCKS = {
    file.stem: dict(re.findall(r"^([\w.-]+)==(\S+)", file.read_text(), re.M))
    for file in (ROOT / "deploy" / "locks").glob("*.txt")
}
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
    done = subprocess.run(command, cwd=ROOT, env=plain, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout


def test_a_fresh_clone_installs_torch_first_and_the_demo_without_test_tools() -> None:
    plan = dry_run("demo")
    (torch,) = re.finditer(r"install .*--no-deps +(torch==\S+)", plan)
    rest = plan.index("-e '.[edge,embed,up]'")
    assert plan.index("-m venv .venv") < torch.start() < rest < plan.index("deploy/up.py")
    assert "deploy/up.py deploy/scenarios/card.yaml --for=60s" in plan
    assert requirement("torch").specifier.contains(LOCKS["torch-cuda"]["torch"])
    assert torch[1] == f"torch=={LOCKS['torch-cuda']['torch']}"
    for early in re.findall(r"install .*'(numba\S+)' '(opencv\S+)'", plan)[0]:
        assert requirement(Requirement(early).name).specifier == Requirement(early).specifier
    assert "test,dev" not in plan


def test_the_index_variable_reaches_torch_alone() -> None:
    plan = dry_run("demo", TORCH_INDEX="file:///some/index")
    assert plan.count("--index-url file:///some/index") == 1
    assert "--index-url file:///some/index torch==" in plan


def test_the_options_of_the_demo_reach_the_launcher() -> None:
    plan = dry_run("demo", SCENARIO="s.yaml", FOR="5s", OUT="o", PORT="8181", DATA="d")
    assert "deploy/up.py s.yaml --for=5s --out o --port 8181 --data d" in plan


def in_the_environment_of_an_image(texts: list[str]) -> list[Requirement]:
    asked = {"python_version": "3.11", "sys_platform": "linux", "platform_system": "Linux", "extra": ""}
    found = [Requirement(text) for text in texts]
    return [each for each in found if each.marker is None or each.marker.evaluate(asked)]


@pytest.mark.parametrize("locks", [("camera",), ("edge", "torch-cpu"), ("edge", "torch-cuda")])
def test_an_image_installs_all_that_the_project_and_its_packages_ask_for(locks: tuple[str, ...]) -> None:
    locked = {name: Version(version) for lock in locks for name, version in LOCKS[lock].items()}
    assert len(locked) == sum(len(LOCKS[lock]) for lock in locks), "a package is in two locks"
    extras = PROJECT["optional-dependencies"]
    asked = PROJECT["dependencies"] + (extras["edge"] + extras["embed"] if "edge" in locks else [])
    for name, version in locked.items():  # and what those ask for, as far as this machine has the same ones
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            if Version(importlib.metadata.version(name)) == version:
                asked = asked + (importlib.metadata.requires(name) or [])
    for each in in_the_environment_of_an_image(asked):
        version = locked.get(canonicalize_name(each.name))
        assert version is not None and each.specifier.contains(version), f"{each}: {version} is locked"
    if "edge" in locks:
        assert {str(locked["torch"]).partition("+")[0]} == {lock.TORCH}
        assert LOCKS["camera"].items() <= LOCKS["edge"].items()
    assert ("torch" in locked) == ("edge" in locks)


def test_every_locked_wheel_has_its_hash() -> None:
    for file in (ROOT / "deploy" / "locks").glob("*.txt"):
        for line in file.read_text().splitlines()[1:]:
            assert re.fullmatch(r"[a-z0-9.-]+==[\w.+]+( --hash=sha256:[0-9a-f]{64})+", line), line
    asked = {Requirement(text).name for text in BUILD}
    assert asked <= LOCKS["build"].keys()


@pytest.mark.parametrize(
    ("image", "locks"), [("camera", {"build", "camera"}), ("edge", {"build", "edge", "torch-$TORCH"})]
)
def test_an_image_installs_locked_wheels_and_the_project_alone(image: str, locks: set[str]) -> None:
    text = (ROOT / "deploy" / f"{image}.Dockerfile").read_text().replace("\\\n", " ")
    installs = re.findall(r"pip install ([^\n&]*)", text)
    assert len(installs) == 3 and all("--no-deps" in words for words in installs)
    assert all(("--require-hashes" in words) != ("--no-index /dist/" in words) for words in installs)
    assert set(re.findall(r"-r deploy/locks/(\S+)\.txt", text)) == locks
    assert "!deploy/locks" in (ROOT / ".dockerignore").read_text().splitlines()


def test_a_release_builds_on_the_digest_of_the_base_image(tmp_path: Path) -> None:
    engine = tmp_path / "engine"
    engine.write_text('#!/bin/sh\n[ "$1" = image ] && echo base@sha256:12 || echo "$@"\n')
    engine.chmod(0o755)
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    command = ["make", "images", f"ENGINE={engine}", "BUILD=--build-arg TORCH=cpu"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout
    assert "pull -q docker.io/library/python:3.11-slim-bookworm" in said and "on base@sha256:12" in said
    built = re.findall(r"^build --build-arg BASE=base@sha256:12 .*TORCH=cpu -f (\S+)", said, re.M)
    assert built == ["deploy/camera.Dockerfile", "deploy/edge.Dockerfile"]


def test_no_package_index_is_written_down() -> None:
    files = ["Makefile", "pyproject.toml", ".ci/run", "deploy/camera.Dockerfile", "deploy/edge.Dockerfile"]
    files += ["deploy/lock.py", *(f"deploy/locks/{name}.txt" for name in LOCKS)]
    for name in files:
        assert "://" not in (ROOT / name).read_text(), f"{name} names a host"


def test_a_second_set_up_has_nothing_to_do() -> None:
    stamps = [ROOT / ".venv" / name for name in (".ok-venv", ".ok-test", ".ok-run")]
    newest = (ROOT / "pyproject.toml").stat().st_mtime
    if not all(s.exists() and s.stat().st_mtime >= newest for s in stamps):
        pytest.skip("this environment was not made by `make test`")
    done = subprocess.run(["make", "-q", ".venv/.ok-test", ".venv/.ok-run"], cwd=ROOT, timeout=60)
    assert done.returncode == 0
