"""What ``kubectl kustomize`` makes of the overlays: the few features that they use."""

import base64
from pathlib import Path
from typing import Any

import yaml

Document = dict[str, Any]
_GENERATORS = {"configMapGenerator": "ConfigMap", "secretGenerator": "Secret"}
_KNOWN = {"apiVersion", "kind", "namespace", "resources", "components", "replicas", "images", *_GENERATORS}


def rendered(folder: Path) -> list[Document]:
    """The documents of an overlay, names of generated ones without their hashes."""
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
