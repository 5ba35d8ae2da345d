"""The compose file: what it promises about networks, checked as data."""

import re

import pytest
import yaml

from freshfield.scenario import load
from tests.conftest import ROOT

COMPOSE = yaml.safe_load((ROOT / "deploy" / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
CAMERAS = {name: s for name, s in SERVICES.items() if "camera-node" in s["command"]}
BASE_IMAGE = "docker.io/library/python:3.11-slim-bookworm"


def test_every_camera_of_the_scenario_has_its_container_and_only_the_page_is_published():
    assert set(CAMERAS) == set(load("quad").cameras)
    for name, service in CAMERAS.items():
        assert re.search(rf"--camera {name}$", service["command"]) and service["environment"]["CAMERA"] == name
    published = {name: s["ports"] for name, s in SERVICES.items() if s.get("ports")}
    assert published == {"edge": ["127.0.0.1:8080:8080"]}


def test_the_only_way_from_a_camera_to_the_edge_is_the_emulator():
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


def test_what_listens_unprotected_says_so_and_the_secure_file_protects_it():
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


def test_each_service_writes_to_volumes_of_its_own_and_to_nothing_else():
    mounted = [volume for service in SERVICES.values() for volume in service["volumes"]]
    assert [v for v in mounted if v.endswith(":ro")] == ["emulator:/emulator:ro"], "read by another one"
    writable = [v.split(":")[0] for v in mounted if not v.endswith(":ro")]
    assert sorted(writable) == sorted(COMPOSE["volumes"]), "a volume that two services write to"
    for name, service in SERVICES.items():
        assert f"{name}:/runs" in service["volumes"] and service["read_only"] is True
        assert service["cap_drop"] == ["ALL"] and service["security_opt"] == ["no-new-privileges"]
        assert re.fullmatch(r"\d+[mg]", service["mem_limit"])
        assert not {"privileged", "cap_add", "user", "pid"} & set(service)
        check = service["healthcheck"]["test"]  # images in the OCI format carry none
        port = re.search(r"--listen \S+:(\d+)", service["command"])
        asks = ["--serving", f"127.0.0.1:{port[1]}"] if port else ["--node", "/runs"]
        assert check == ["CMD", "python", "-m", "freshfield_up.healthy", *asks], name


@pytest.mark.parametrize("name", ["camera", "edge"])
def test_an_image_runs_as_nobody_in_particular(name):
    text = (ROOT / "deploy" / f"{name}.Dockerfile").read_text()
    stages = text.split("\nFROM ")
    assert stages[0].endswith(f"\nARG BASE={BASE_IMAGE}"), "make images puts a digest here"
    assert [stage.split()[0] for stage in stages[1:]] == ["${BASE}"] * 2
    assert re.search(r"^USER freshfield$", stages[-1], re.M)
    assert "apt-get" not in text, "wheels bring what they need"
    sources = re.findall(r"^COPY (?!--from)(.+) \S+$", text, re.M)
    for path in " ".join(sources).split():
        assert (ROOT / path).exists(), f"{name}.Dockerfile copies {path}, which is gone"
    assert re.findall(r"^RUN freshfield .*$", text, re.M) == (["RUN freshfield warm-up"] if name == "edge" else [])
