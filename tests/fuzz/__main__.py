"""Fuzz what strangers may send, guided by coverage (atheris).

    python -m tests.fuzz                                 # each target with five thousand inputs
    python -m tests.fuzz request --runs 1000000          # longer

What it finds it leaves in runs/fuzz/TARGET/found-*; with its cause mended, that file belongs into corpus/.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

MOST_INPUT_BYTES = 2**14
FOUND = Path("runs/fuzz")


def fuzz_one(name: str, runs: int) -> None:
    """Fuzz one target in this process, which it ends."""
    import atheris

    # Atheris keeps the result of every comparison of arrays that it has instrumented, for ever.
    with atheris.instrument_imports(
        include=["freshfield", "camera_node", "channel_emu", "edge_server", "yaml", "mcap"],
        exclude=["freshfield.geometry"],
    ):
        from tests.fuzz import targets

        shutil.rmtree(FOUND / name, ignore_errors=True)
        work, corpus = FOUND / name / "work", FOUND / name / "corpus"
        work.mkdir(parents=True)
        corpus.mkdir()
        target = targets.TARGETS[name](work)  # imports the rest
    for number, seed in enumerate(targets.seeds(name)):
        (corpus / str(number)).write_bytes(seed[:MOST_INPUT_BYTES])
    bounds = (f"runs={runs}", f"max_len={MOST_INPUT_BYTES}", "len_control=0", "rss_limit_mb=1024", "timeout=20")
    options = [f"-{option}" for option in (*bounds, "seed=1", "verbosity=0", f"artifact_prefix={FOUND / name}/found-")]

    def take(data: bytes) -> None:
        target(data)

    atheris.Setup([sys.argv[0], *options, str(corpus)], take)
    atheris.Fuzz()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("targets", nargs="*", help="names of tests/fuzz/targets.py [all]")
    options.add_argument("--runs", type=int, default=5000, help="inputs for each [%(default)s]")
    given = options.parse_args()
    if len(given.targets) == 1:
        fuzz_one(given.targets[0], given.runs)
    from tests.fuzz.targets import TARGETS

    failed = [
        name
        for name in given.targets or TARGETS
        if subprocess.run([sys.executable, "-m", "tests.fuzz", name, "--runs", str(given.runs)]).returncode
    ]
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
