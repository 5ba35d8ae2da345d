"""``edge-server keys``: makes a certificate authority, and for each process what it needs for mutual TLS.

For development and tests in a private network: keys have no password, certificates are valid for a year.
"""

from __future__ import annotations

import argparse
import ipaddress
import os
import re
import secrets
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from edge_server.live.live_constants import CERTIFICATE_DAYS
from freshfield.files import out_folder
from freshfield.scenario import load
from freshfield.transport import TransportError

_REQUEST = f"openssl req -x509 -days {CERTIFICATE_DAYS} -noenc -newkey ec -pkeyopt ec_paramgen_curve:prime256v1"
# Of the authority. Python 3.13 verifies strictly (RFC 5280): an authority says what its key is for, and every
# certificate which key it holds and which signed it.
_AUTHORITY = ("basicConstraints=critical,CA:TRUE", "keyUsage=critical,keyCertSign,cRLSign", "subjectKeyIdentifier=hash")
_MOST_NAME_CHARS = 64  # in a certificate's common name
_HERE = ("localhost", "127.0.0.1", "::1")


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = argparse.ArgumentParser(
        "edge-server keys",
        description="Make a development certificate authority (CA), and a folder with "
        "certificate, key and CA for each process of a scenario: edge, emulator, every camera, operator and "
        "viewer. The edge's folder also holds tokens.txt, with which people log in to the page; kustomization.yaml "
        "makes Kubernetes secrets of all that (docs/how-to/kubernetes.md).",
    )
    parser.add_argument("scenario", help="scenario file, or the name of a shipped one")
    parser.add_argument("--out", type=out_folder, required=True, metavar="DIR", help="folder to write; must not exist")
    for process in ("edge", "emulator"):
        parser.add_argument(
            f"--{process}",
            action="append",
            default=[],
            metavar="HOST",
            help=f"name or address under which the {process} is reached, besides localhost; may be repeated",
        )
    args = parser.parse_args(argv)
    make_keys(args.out, load(args.scenario).cameras, args.edge, args.emulator)
    print(f"{args.out}: copy each folder to the machine of its process, and keep the rest to yourself")
    return 0


def make_keys(out: Path, cameras: Sequence[str], edge: Sequence[str], emulator: Sequence[str]) -> None:
    """Write the folder ``out``, whole or not at all.

    cameras: their ids.
    edge, emulator: names or addresses under which they are reached, besides localhost.
    Raises TransportError for an invalid host, for a camera named like another process, or if openssl cannot
    make a certificate; FileExistsError if ``out`` exists.
    """
    names = {"edge": "operator", "emulator": "camera:*", "operator": "operator", "viewer": "viewer"}
    if doubled := names.keys() & set(cameras):
        raise TransportError(f"keys: a camera cannot be called {' or '.join(sorted(doubled))}: rename it")
    names |= {camera: f"camera:{camera}" for camera in cameras}
    hosts = {"edge": edge, "emulator": emulator}
    alternatives = {p: [_alternative(host) for host in (*hosts.get(p, ()), *_HERE)] for p in names}
    if out.exists():
        raise FileExistsError(f"--out {out}: exists already: name a new folder")
    before = os.umask(0o077)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".keys-", dir=out.parent) as unfinished:
            whole = Path(unfinished) / "keys"
            whole.mkdir()
            _certify(whole, "freshfield development", _AUTHORITY)
            for process, name in names.items():
                folder = whole / process
                folder.mkdir()
                reached = f"subjectAltName={','.join(alternatives[process])}"
                keys = ("subjectKeyIdentifier=hash", "authorityKeyIdentifier=keyid")
                _certify(folder, name, (reached, *keys), authority=whole)
                (folder / "ca.pem").write_bytes((whole / "cert.pem").read_bytes())
            lines = [f"{name} {secrets.token_urlsafe(24)}\n" for name in ("operator", "viewer")]
            (whole / "edge" / "tokens.txt").write_text("".join(lines))
            (whole / "kustomization.yaml").write_text(_kubernetes_secrets(cameras))
            whole.rename(out)
    finally:
        os.umask(before)


def _kubernetes_secrets(cameras: Sequence[str]) -> str:
    """A Kustomize component (deploy/kubernetes): a secret for each kind of pod. Camera pods share one; each mounts
    the files of its own number alone."""
    files = {"camera-keys": [f"ca.pem={cameras[0]}/ca.pem"] if cameras else []}
    for process in ("edge", "emulator"):
        files[f"{process}-keys"] = [f"{process}/{name}.pem" for name in ("cert", "key", "ca")]
    files["edge-keys"].append("edge/tokens.txt")
    for number, camera in enumerate(cameras):
        files["camera-keys"] += [f"{number}-{name}.pem={camera}/{name}.pem" for name in ("cert", "key")]
    lines = ["apiVersion: kustomize.config.k8s.io/v1alpha1", "kind: Component", "secretGenerator:"]
    for secret, listed in files.items():
        lines += [f"  - name: {secret}", "    files:", *(f"      - {file}" for file in listed)]
    return "\n".join(lines) + "\n"


def _certify(folder: Path, name: str, extensions: Sequence[str], authority: Path | None = None) -> None:
    """Write cert.pem and key.pem into ``folder``, signed by ``authority`` or by itself."""
    if len(name) > _MOST_NAME_CHARS:
        raise TransportError(f"{name}: a certificate's name has {_MOST_NAME_CHARS} characters at most")
    signed: list[str | Path] = (
        [] if authority is None else ["-CA", authority / "cert.pem", "-CAkey", authority / "key.pem"]
    )
    with tempfile.NamedTemporaryFile("w", suffix=".cnf") as config:  # else openssl's own adds extensions
        config.write("[req]\ndistinguished_name=name\n[name]\n")
        config.flush()
        command: list[str | Path] = [*_REQUEST.split(), "-config", config.name, "-subj", f"/CN={name}", *signed]
        for extension in extensions:
            command += ["-addext", extension]
        command += ["-keyout", folder / "key.pem", "-out", folder / "cert.pem"]
        try:
            done = subprocess.run(command, capture_output=True, text=True)
        except FileNotFoundError:
            raise TransportError("keys: the command openssl (3.0 or newer) is not installed") from None
    if done.returncode != 0:
        raise TransportError(f"keys: openssl made no certificate of {name}: {done.stderr.strip()[-300:]}")


def _alternative(host: str) -> str:
    try:
        return f"IP:{ipaddress.ip_address(host)}"
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9_.-]+", host):
            raise TransportError(f"keys: expected the name or address of a host, got {host!r}") from None
        return f"DNS:{host}"
