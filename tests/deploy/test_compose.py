"""The compose file: what it promises about networks, checked as data and, where an engine runs, for real."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import urllib.request
from pathlib import Path

import pytest
import yaml

from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.scan.carried_field import CarriedField
from freshfield.scenario import load
from freshfield_up.cli import main
from tests.conftest import ROOT
from tests.support import wait_until

FILE = ROOT / "deploy" / "compose.yaml"
COMPOSE = yaml.safe_load(FILE.read_text())
SERVICES = COMPOSE["services"]
CAMERAS = {name: s for name, s in SERVICES.items() if "camera-node" in s["command"]}
BASE_IMAGE = "docker.io/library/python:3.11-slim-bookworm"


def test_every_camera_of_the_scenario_has_its_container() -> None:
    scenario = load(ROOT / "deploy" / "scenarios" / "quad.yaml")
    assert set(CAMERAS) == set(scenario.cameras)
    for name, service in CAMERAS.items():
        assert re.search(rf"--camera {name}$", service["command"])
        assert service["environment"]["CAMERA"] == name


def test_the_only_way_from_a_camera_to_the_edge_is_the_emulator() -> None:
    edge, emulator = set(SERVICES["edge"]["networks"]), set(SERVICES["emulator"]["networks"])
    assert edge and edge <= set(COMPOSE["networks"])
    for name, service in CAMERAS.items():
        networks = set(service["networks"])
        assert networks and not networks & edge, f"{name} shares a network with the edge"
        assert networks <= emulator
        assert "--to emulator:" in service["command"]
        assert all(COMPOSE["networks"][n]["internal"] for n in networks), "an engine may route between bridges"
    assert edge <= emulator
    assert not any("network_mode" in s or "links" in s for s in SERVICES.values())


def test_only_the_page_is_published_and_only_on_this_machine() -> None:
    published = {name: s["ports"] for name, s in SERVICES.items() if s.get("ports")}
    assert published == {"edge": ["127.0.0.1:8080:8080"]}


def test_what_listens_unprotected_says_so_and_the_secure_file_protects_it() -> None:
    secure = yaml.safe_load((ROOT / "deploy" / "compose.secure.yaml").read_text())["services"]
    assert secure.keys() == SERVICES.keys()
    tls = ["--tls-cert", "/keys/cert.pem", "--tls-key", "/keys/key.pem", "--tls-ca", "/keys/ca.pem"]
    for name, service in SERVICES.items():
        words, changed = service["command"].split(), secure[name]["command"].split()
        assert ("--insecure" in words) == ("--listen" in words)
        added = [*tls, *(["--token-file", "/keys/tokens.txt"] if name == "edge" else [])]
        assert sorted(changed) == sorted([*(w for w in words if w != "--insecure"), *added]), name
        assert secure[name]["volumes"] == [*service["volumes"], f"./keys/{name}:/keys:ro"]
        check = secure[name].get("healthcheck")
        assert check is None or check["test"] == [*service["healthcheck"]["test"], *tls]
        assert (check is None) == (name in CAMERAS)


def test_each_service_writes_to_volumes_of_its_own_and_to_nothing_else() -> None:
    mounted = [volume for service in SERVICES.values() for volume in service["volumes"]]
    assert [v for v in mounted if v.endswith(":ro")] == ["emulator:/emulator:ro"], "read by another one"
    writable = [v.split(":")[0] for v in mounted if not v.endswith(":ro")]
    assert sorted(writable) == sorted(COMPOSE["volumes"]), "a volume that two services write to"
    for name, service in SERVICES.items():
        assert f"{name}:/runs" in service["volumes"] and service["read_only"] is True
        assert service["cap_drop"] == ["ALL"] and service["security_opt"] == ["no-new-privileges"]
        assert re.fullmatch(r"\d+[mg]", service["mem_limit"])


def test_every_service_has_a_health_check_and_no_privileges() -> None:
    for name, service in SERVICES.items():
        check = service["healthcheck"]["test"]  # images in the OCI format carry none
        assert check[:4] == ["CMD", "python", "-m", "freshfield_up.healthy"]
        port = re.search(r"--listen \S+:(\d+)", service["command"])
        assert check[4:] == (["--serving", f"127.0.0.1:{port[1]}"] if port else ["--node", "/runs"]), name
        assert not {"privileged", "cap_add", "user", "pid"} & set(service)


@pytest.mark.parametrize("name", ["camera", "edge"])
def test_an_image_runs_as_nobody_in_particular(name: str) -> None:
    text = (ROOT / "deploy" / f"{name}.Dockerfile").read_text()
    stages = text.split("\nFROM ")
    assert stages[0].endswith(f"\nARG BASE={BASE_IMAGE}"), "make images puts a digest here"
    assert [stage.split()[0] for stage in stages[1:]] == ["${BASE}"] * 2
    assert re.search(r"^USER freshfield$", stages[-1], re.M)
    assert "apt-get" not in text, "wheels bring what they need"
    sources = re.findall(r"^COPY (?!--from)(.+) \S+$", text, re.M)
    for path in " ".join(sources).split():
        assert (ROOT / path).exists(), f"{name}.Dockerfile copies {path}, which is gone"


def test_the_edges_image_compiles_the_kernels_of_a_field_that_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = re.findall(r"^RUN freshfield (.*)$", (ROOT / "deploy" / "edge.Dockerfile").read_text(), re.MULTILINE)
    compiled = list[object]()
    for kind in (LayeredField, CarriedField):
        monkeypatch.setattr(kind, "warm_up", lambda field, cameras: compiled.append((type(field), cameras)) or 0.0)
    assert main(line.split()) == 0
    assert compiled == [(LayeredField, 1), (CarriedField, 1)]


def engine() -> tuple[list[str], str]:
    """A compose command that works here and the engine below it, or skip with the reason."""
    tried = []
    for command, check in ((["docker", "compose"], ["docker", "info"]), (["podman-compose"], ["podman", "info"])):
        if shutil.which(command[0]) is None or shutil.which(check[0]) is None:
            tried.append(f"{command[0]} is not installed")
            continue
        # An engine that answers may still be unable to start anything, as inside another container.
        trial = [check[0], "run", "--rm", BASE_IMAGE, "true"]
        for probe in ([*command, "version"], check, trial):
            done = subprocess.run(probe, capture_output=True, text=True, timeout=300)
            if done.returncode != 0:
                tried.append(f"{' '.join(probe)}: {(done.stderr or done.stdout).strip()[:100]}")
                break
        else:
            return command, check[0]
    pytest.skip(f"no working compose: {'; '.join(tried)}")


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_deployment_streams_and_accounts_for_every_frame(tmp_path: Path) -> None:
    command, below = engine()
    compose = [*command, "-f", str(FILE)]

    def run(*words: str) -> str:
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=1200.0)
        assert done.returncode == 0, f"{' '.join(words)}: {done.stderr[-2000:]}"
        return done.stdout

    if "FRESHFIELD_IMAGES_ARE_BUILT" not in os.environ:
        run(*compose, "build")
    try:
        run(*compose, "up", "-d")
        wait_until(page_answers, "the page did not answer", 180.0)
        image = "localhost/freshfield-edge"
        status = (below, "run", "--rm", "-v", "deploy_edge:/runs:ro", image, "cat", "/runs/edge.json")
        wait_until(lambda: json.loads(run(*status))["updates"]["count"] >= 5, "no five updates", 300.0)
        for group in (list(CAMERAS), ["emulator"], ["edge"]):
            run(*compose, "stop", *group)
        volumes = [word for s in SERVICES for word in ("-v", f"deploy_{s}:/from/{s}:ro")]
        joined = "cp -r /from/*/* /runs && edge-server report /runs >&2 && cat /runs/report.json"
        report = json.loads(run(below, "run", "--rm", *volumes, image, "sh", "-c", joined))
    finally:
        subprocess.run([*compose, "down", "-v"], cwd=ROOT, capture_output=True, timeout=120.0)
    assert report["frames"]["closes"]
    assert report["frames"]["delivered"] > 100
    assert set(report["age_ms"]["by_camera"]) >= set(CAMERAS) - {"cam00"}
    assert report["updates"]["count"] >= 5 and report["fidelity"]["final"]["psnr_db"] is not None


def page_answers() -> bool:
    try:
        with urllib.request.urlopen("http://127.0.0.1:8080", timeout=2.0) as page:
            return page.status == 200
    except OSError:
        return False
