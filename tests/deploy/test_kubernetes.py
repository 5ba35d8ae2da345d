"""deploy/kubernetes: valid by the published schemas, every name refers to what there is, and only the emulator reaches
the edge."""

import base64
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

import camera_node.cli
import channel_emu.cli
import edge_server.cli
import edge_server.run_command
from edge_server.live.keys_command import make_keys
from freshfield.scenario import load
from tests.conftest import ROOT

Document = dict[str, Any]
_GENERATORS = {"configMapGenerator": "ConfigMap", "secretGenerator": "Secret"}
_KNOWN = {"apiVersion", "kind", "namespace", "resources", "components", "replicas", "images", *_GENERATORS}


def rendered(folder: Path) -> list[Document]:
    """What ``kubectl kustomize`` makes of an overlay, by the few features used, names of generated ones without their
    hashes."""
    overlay = yaml.safe_load((folder / "kustomization.yaml").read_text())
    documents = _accumulated(folder)
    counts = {each["name"]: each["count"] for each in overlay.get("replicas", ())}
    for document in documents:
        if document["kind"] != "Namespace":
            document["metadata"]["namespace"] = overlay["namespace"]
        if "replicas" in document.get("spec", {}):
            name = document["metadata"]["name"]
            document["spec"]["replicas"] = counts.get(name, document["spec"]["replicas"])
    return documents


def _accumulated(folder: Path) -> list[Document]:
    own = yaml.safe_load((folder / "kustomization.yaml").read_text())
    assert own.keys() <= _KNOWN, f"{folder}: rendered() knows no {own.keys() - _KNOWN}"
    found: list[Document] = []
    for name in (*own.get("resources", ()), *own.get("components", ())):
        path = folder / name
        found += _accumulated(path) if path.is_dir() else yaml.safe_load_all(path.read_text())
    for key, kind in _GENERATORS.items():
        for each in own.get(key, ()):
            document = {"apiVersion": "v1", "kind": kind, "metadata": {"name": each["name"]}}
            document["data"] = dict(pair.split("=", 1) for pair in each.get("literals", ()))
            for file in each.get("files", ()):
                name, _, path = file.rpartition("=")
                content = (folder / path).read_bytes()
                document["data"][name or Path(path).name] = base64.b64encode(content).decode()
            found.append(document | ({"type": "Opaque"} if kind == "Secret" else {}))
    return found


SCENES = sorted(folder.name for folder in (ROOT / "deploy/kubernetes/overlays").iterdir())
SCHEMAS = "1.31"
CLI = {"edge-server": edge_server.cli, "channel-emu": channel_emu.cli, "camera-node": camera_node.cli}


@pytest.fixture(scope="module")
def overlays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the overlays with their keys."""
    copy = tmp_path_factory.mktemp("kubernetes") / "kubernetes"
    shutil.copytree(ROOT / "deploy/kubernetes", copy, ignore=shutil.ignore_patterns("keys"))
    for scene in SCENES:
        make_keys(copy / "overlays" / scene / "keys", load(scene).cameras, ["edge"], ["emulator"])
    return copy / "overlays"


@pytest.fixture(params=SCENES)
def scene(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def documents(overlays: Path, scene: str) -> list[Document]:
    return rendered(overlays / scene)


def of(documents: list[Document], *kinds: str) -> dict[str, Document]:
    return {d["metadata"]["name"]: d for d in documents if d["kind"] in kinds}


def pods(documents: list[Document]) -> dict[str, Document]:
    """Name -> template of its pods."""
    return {name: d["spec"]["template"] for name, d in of(documents, "StatefulSet", "Deployment").items()}


def test_they_follow_the_published_schemas(documents):
    validator = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is not installed (extra dev)")
    for document in documents:
        validator.validate(document, SCHEMAS, strict=True)


def test_a_pod_for_each_camera_and_commands_that_their_programs_take(monkeypatch, scene, documents):
    (config,) = of(documents, "ConfigMap").values()
    assert config["data"] == {"SCENARIO": scene}
    cameras = load(scene).cameras
    assert of(documents, "StatefulSet")["camera"]["spec"]["replicas"] == len(cameras)
    last = {"$(SCENARIO)": scene, "$(INDEX)": str(len(cameras) - 1)}
    for name, template in pods(documents).items():
        (container,) = template["spec"]["containers"]
        program, *words = (re.sub(r"\$\(\w+\)", lambda found: last[found[0]], word) for word in container["command"])
        taken = []
        runs = edge_server.run_command if program == "edge-server" else CLI[program]
        monkeypatch.setattr(runs, "_run", lambda args, taken=taken: taken.append(args) or 0)
        assert CLI[program].main(words) == 0 and taken[0].scenario == scene, name
        if name == "camera":
            assert camera_node.cli._chosen(load(scene), taken[0]) == (cameras[-1],)
        probe, started = (container[f"{kind}Probe"]["exec"]["command"] for kind in ("liveness", "startup"))
        assert probe[:3] == started[:3] == ["python", "-m", "freshfield_up.healthy"]
        if name != "camera":  # asked at the port it listens on, as the Service names it
            port = taken[0].listen.rpartition(":")[2]
            assert f"--serving=127.0.0.1:{port}" in probe and container["readinessProbe"]["exec"]["command"] == probe
            listed = {each["port"] for each in of(documents, "Service")[name]["spec"]["ports"]}
            assert listed == {each["containerPort"] for each in container["ports"]} and int(port) in listed
    assert container["env"][0]["name"] == "INDEX"


def test_the_emulator_is_the_only_way_from_a_camera_to_the_edge(documents):
    policies = of(documents, "NetworkPolicy")
    labels = {name: template["metadata"]["labels"] for name, template in pods(documents).items()}
    assert policies["default-deny"]["spec"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}

    def allowed(way: str, peers: str, name: str, other: str, port: int) -> bool:
        """Whether some policy of pod ``name`` lets it talk with ``other``."""
        for policy in policies.values():
            chosen = policy["spec"]["podSelector"].get("matchLabels", {}).items()
            if chosen <= labels[name].items():
                for rule in policy["spec"].get(way, ()):
                    named = [p["podSelector"]["matchLabels"].items() for p in rule.get(peers, ())]
                    matching = not named or any(each <= labels[other].items() for each in named)
                    if port in [each["port"] for each in rule["ports"]] and matching:
                        return True
        return False

    def reaches(source: str, target: str, port: int) -> bool:
        return allowed("egress", "to", source, target, port) and allowed("ingress", "from", target, source, port)

    ways = {(a, b, port) for a in labels for b in labels if a != b for port in (7000, 7001) if reaches(a, b, port)}
    assert ways == {("camera", "emulator", 7001), ("emulator", "edge", 7000), ("edge", "emulator", 7001)}


def test_pods_are_confined_limited_and_watched(documents):
    (namespace,) = of(documents, "Namespace").values()
    assert namespace["metadata"]["labels"] == {"pod-security.kubernetes.io/enforce": "restricted"}
    for template in pods(documents).values():
        spec = template["spec"]
        assert spec["securityContext"]["runAsNonRoot"] and spec["automountServiceAccountToken"] is False
        for container in (*spec["containers"], *spec.get("initContainers", ())):
            confined = container["securityContext"]
            assert confined["readOnlyRootFilesystem"] and not confined["allowPrivilegeEscalation"]
            assert confined["capabilities"] == {"drop": ["ALL"]}
            assert {"cpu", "memory"} <= container["resources"]["requests"].keys()
            assert "memory" in container["resources"]["limits"]
    edge = pods(documents)["edge"]
    scraped = edge["metadata"]["annotations"]["prometheus.io/port"]
    assert f"--metrics-port={scraped}" in edge["spec"]["containers"][0]["command"]
