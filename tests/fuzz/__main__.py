"""Fuzz what strangers may send, guided by coverage (atheris); bounds memory, and the time of each input.

    python -m tests.fuzz                                 # each target with five thousand inputs
    python -m tests.fuzz request --runs 1000000          # longer

What it finds it leaves as a file whose name it prints; with its cause mended, that file belongs into corpus/.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from freshfield.machine_load import rss_mb
from tests.support import work_ms

MOST_INPUT_BYTES = 2**14
MOST_GROWTH_MB, MOST_NEW_BLOCKS = 48, 50_000
"""From the end of the first tenth of a run: of memory, where fuzzing itself keeps the inputs that reached
something new, and of what Python has allocated."""


def fuzz_one(name: str, runs: int) -> None:
    """Fuzz one target in this process, which it ends."""
    import atheris

    # Atheris keeps the result of every comparison of arrays that it has instrumented, for ever.
    with atheris.instrument_imports(
        include=["freshfield", "camera_node", "channel_emu", "edge_server", "yaml", "mcap"],
        exclude=["freshfield.geometry"],
    ):
        from tests.fuzz import targets

        folder = Path(tempfile.mkdtemp(prefix=f"fuzz-{name}-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        (work := folder / "work").mkdir()
        target = targets.TARGETS[name](work)  # imports the rest
    (corpus := folder / "corpus").mkdir()
    for number, seed in enumerate(targets.seeds(name)):
        (corpus / str(number)).write_bytes(seed[:MOST_INPUT_BYTES])
    most_ms = targets.MOST_MS.get(name, targets.MOST_FILE_MS)
    outcomes: Counter[str] = Counter()
    slowest_ms, early_mb, early_blocks = 0.0, 0.0, 0

    def take(data: bytes) -> None:
        nonlocal slowest_ms, early_mb, early_blocks
        at = time.thread_time()
        outcomes[target(data)] += 1
        took_ms = (time.thread_time() - at) * 1e3
        if took_ms > slowest_ms:  # by itself, or because others compute on the same cores?
            took_ms = min(took_ms, work_ms(lambda: target(data)))
        slowest_ms = max(slowest_ms, took_ms)
        assert took_ms < most_ms, f"an input of {len(data)} bytes took {took_ms:.0f} ms"
        if outcomes.total() == runs // 10:
            early_mb, early_blocks = rss_mb(), sys.getallocatedblocks()
        if outcomes.total() == runs:
            grown_mb, blocks = rss_mb() - early_mb, sys.getallocatedblocks() - early_blocks
            common = ", ".join(f"{word} {count}" for word, count in outcomes.most_common(6))
            grown = f"memory grown by {grown_mb:.1f} MB and {blocks} blocks"
            print(f"{name}: {runs} inputs, slowest {slowest_ms:.1f} ms, {grown}; {common}", flush=True)
            shutil.rmtree(folder)
            os._exit(grown_mb > MOST_GROWTH_MB or blocks > MOST_NEW_BLOCKS)

    options = (
        "verbosity=0",
        f"max_len={MOST_INPUT_BYTES}",
        "len_control=0",
        "rss_limit_mb=2048",
        "timeout=20",
        "seed=1",
    )
    flags = [f"-{option}" for option in (*options, f"artifact_prefix={folder}/found-")]
    atheris.Setup([sys.argv[0], *flags, str(corpus)], take)
    atheris.Fuzz()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("targets", nargs="*", help="names of tests/fuzz/targets.py [all]")
    options.add_argument("--runs", type=int, default=5000, help="inputs for each [%(default)s]")
    options.add_argument("--jobs", type=int, default=1)
    given = options.parse_args()
    if len(given.targets) == 1:
        fuzz_one(given.targets[0], given.runs)
    from tests.fuzz.targets import TARGETS

    def run(name: str) -> str | None:
        command = [sys.executable, "-m", "tests.fuzz", name, "--runs", str(given.runs)]
        done = subprocess.run(command, stderr=subprocess.STDOUT, stdout=subprocess.PIPE)
        said = done.stdout.decode(errors="replace").splitlines()
        print("\n".join(said[-60:] if done.returncode else [line for line in said if line.startswith(f"{name}: ")]))
        return name if done.returncode else None

    with ThreadPoolExecutor(given.jobs) as pool:
        failed = [name for name in pool.map(run, given.targets or TARGETS) if name]
    if failed:
        sys.exit(f"{', '.join(failed)}: failed")


if __name__ == "__main__":
    main()
