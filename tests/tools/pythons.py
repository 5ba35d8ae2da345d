"""Runs tests with other versions of Python, each in an environment of its own, and keeps the result.

    python -m tests.tools.pythons 3.12 3.13 [--tests PATH ...] [--json docs/results/pythons.json]

A version is looked for as ``python3.12`` and with uv and pyenv, where they are installed; it may also be the file of an
interpreter. Everything is installed from the project's own declaration, with the words of ``--pip``
("--extra-index-url ADDRESS" of torch without CUDA). Exit code: 0 all tests passed, 1 some did not, 2 an
interpreter is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any

from edge_server.machine import commit, machine
from freshfield.files import write_json
from tests.conftest import ROOT

FACTS = """
import importlib.metadata, json, platform
names = ("numpy", "numba", "torch", "grpcio", "protobuf", "opencv-contrib-python-headless", "onnxruntime")
found = {name: importlib.metadata.version(name) for name in names}
print(json.dumps({"python": platform.python_version(), "packages": found}))
"""
_QUICK = "not slow and not browser"
_PASSES = (  # as `make test` has them
    ["-n", "logical", "--dist", "worksteal", "-m", f"{_QUICK} and side_by_side"],
    ["-m", f"{_QUICK} and not side_by_side"],
)


class MissingPython(ValueError):
    """No interpreter of that version; the message says how to get one."""


def interpreter(wanted: str) -> str:
    """The file of an interpreter. wanted: a version such as 3.12, or the file itself. Raises MissingPython."""
    if Path(wanted).is_file():
        return wanted
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    candidates = [shutil.which(f"python{wanted}"), *map(str, sorted(pyenv.glob(f"{wanted}*/bin/python")))]
    if shutil.which("uv"):
        found = subprocess.run(["uv", "python", "find", wanted], capture_output=True, text=True, check=False)
        candidates.append(found.stdout.strip())
    for path in filter(None, candidates):
        if subprocess.run([path, "-c", ""], capture_output=True, check=False).returncode == 0:  # no empty shim
            return path
    raise MissingPython(
        f"Python {wanted} not found: install it (uv python install {wanted}, or pyenv install {wanted}), or name the "
        "interpreter's file"
    )


def tested(python: str, venvs: Path, pip: list[str], tests: list[str]) -> dict[str, Any]:
    """Install into an environment below ``venvs`` and run the tests there; the entry of the result file."""
    version = subprocess.check_output([python, "-c", "import platform; print(platform.python_version())"], text=True)
    home = venvs / version.strip()
    if not home.exists():
        subprocess.run([python, "-m", "venv", str(home)], check=True)
    run = [str(home / "bin/python"), "-m"]
    print(f"Python {version.strip()}: installing", flush=True)
    install = [*run, "pip", "install", "-q", "--no-compile", *pip, "-e", f"{ROOT}[edge,embed,test]"]
    subprocess.run(install, check=True, cwd=ROOT)
    # The tree under test is the installed one, not that of this process.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONPYCACHEPREFIX"] = str(home / "byte-code")
    facts = json.loads(subprocess.check_output([run[0], "-c", FACTS], text=True, cwd=ROOT, env=environment))
    counts: Counter[str] = Counter()
    failed: list[str] = []
    for words in _PASSES:
        with tempfile.TemporaryDirectory() as folder:
            xml = Path(folder) / "result.xml"
            command = [*run, "pytest", "-p", "no:cacheprovider", *words, f"--junitxml={xml}", *tests]
            subprocess.run(command, cwd=ROOT, env=environment, check=False)
            if not xml.exists():
                failed.append(f"no result of pytest {' '.join(words)}")
                continue
            suite = ElementTree.parse(xml).getroot()[0]
        counts.update({name: int(suite.attrib[name]) for name in ("tests", "failures", "errors", "skipped")})
        failed += [
            f"{case.attrib['classname']}::{case.attrib['name']}"
            for case in suite.iter("testcase")
            if case.find("failure") is not None or case.find("error") is not None
        ]
    return {**facts, **counts, "failed": failed}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("pythons", nargs="+", metavar="VERSION", help="3.12, or the file of an interpreter")
    parser.add_argument("--tests", nargs="+", default=["tests"], metavar="PATH", help="[all quick ones]")
    parser.add_argument("--pip", type=shlex.split, default=[], metavar="WORDS", help="more words for pip install")
    parser.add_argument("--venvs", type=Path, default=ROOT / ".venv/pythons", metavar="DIR", help="[%(default)s]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="file to write the result to")
    args = parser.parse_args()
    try:
        found = [interpreter(wanted) for wanted in args.pythons]
    except MissingPython as error:
        print(f"pythons: {error}", file=sys.stderr)
        return 2
    results = [tested(python, args.venvs, args.pip, args.tests) for python in found]
    about = {"date": date.today().isoformat(), "commit": commit(), "machine": machine(), "tests": args.tests}
    if args.json is not None:
        write_json(args.json, {**about, "pythons": results}, indent=1)
    for result in results:
        print({name: value for name, value in result.items() if name != "packages"})
    return 0 if all(result.get("tests") and not result["failed"] for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
