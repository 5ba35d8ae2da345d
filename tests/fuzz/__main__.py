"""Fuzz what strangers may send, guided by coverage (atheris); bounds memory, and the time of each input.

    python -m tests.fuzz                                 # each target for five seconds
    python -m tests.fuzz request header --runs 1000000   # longer

What it finds it leaves as a file whose name it prints; with its cause mended, that file belongs into corpus/.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.support import work_ms

MOST_INPUT_BYTES = 2**14
MOST_GROWTH_MB, MOST_NEW_BLOCKS = 48, 50_000
"""From the end of the first tenth of a run: of memory, where fuzzing itself keeps the inputs that reached
something new, and of what Python has allocated."""


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def fuzz_one(name: str, runs: int, seconds: float, folder: Path) -> None:
    """Fuzz one target in this process, which it ends."""
    import atheris

    # Atheris keeps the result of every comparison of arrays that it has instrumented, for ever.
    with atheris.instrument_imports(
        include=["freshfield", "camera_node", "channel_emu", "edge_server", "yaml", "mcap"],
        exclude=["freshfield.geometry"],
    ):
        from tests.fuzz import targets

        (work := folder / "work").mkdir()
        target = targets.TARGETS[name](work)  # imports the rest
    (corpus := folder / "corpus").mkdir()
    words: set[bytes] = set()
    for number, seed in enumerate(targets.seeds(name)):
        (corpus / str(number)).write_bytes(seed[:MOST_INPUT_BYTES])
        words.update(re.findall(rb"[A-Za-z_][\w-]{2,30}", seed))
    (folder / "words").write_bytes(b"".join(b'"%s"\n' % word for word in sorted(words)))
    most_ms = targets.MOST_MS.get(name, targets.MOST_FILE_MS)
    outcomes: Counter[str] = Counter()
    begun, slowest_ms, after_a_tenth_mb, blocks = time.monotonic(), 0.0, 0.0, 0

    def take(data: bytes) -> None:
        nonlocal slowest_ms, after_a_tenth_mb, blocks
        at = time.thread_time()
        outcomes[target(data)] += 1
        took_ms = (time.thread_time() - at) * 1e3
        if took_ms > slowest_ms:  # by itself, or because others compute on the same cores?
            took_ms = min(took_ms, work_ms(lambda: target(data)))
        slowest_ms = max(slowest_ms, took_ms)
        assert took_ms < most_ms, f"an input of {len(data)} bytes took {took_ms:.0f} ms"
        done, passed = outcomes.total(), time.monotonic() - begun
        part = done / runs if runs else passed / seconds
        if part >= 0.1 and not after_a_tenth_mb:
            after_a_tenth_mb, blocks = resident_mb(), sys.getallocatedblocks()
        if part >= 1:
            grown_mb, new = resident_mb() - after_a_tenth_mb, sys.getallocatedblocks() - blocks
            common = ", ".join(f"{word} {count}" for word, count in outcomes.most_common(6))
            print(
                f"{name}: {done} inputs in {passed:.0f} s, slowest {slowest_ms:.1f} ms, memory "
                f"{resident_mb():.0f} MB, grown by {grown_mb:.1f} and {new} blocks; {common}",
                flush=True,
            )
            os._exit(grown_mb > MOST_GROWTH_MB or new > MOST_NEW_BLOCKS)

    options = [
        f"-artifact_prefix={folder.parent}/{name}-",
        *([f"-dict={folder / 'words'}"] if words else []),  # an empty one is an error
        "-verbosity=0",
        f"-max_len={MOST_INPUT_BYTES}",
        "-len_control=0",
        "-rss_limit_mb=2048",
        "-timeout=20",
        "-seed=1",
        str(corpus),
    ]
    atheris.Setup([sys.argv[0], *options], take)
    atheris.Fuzz()


def main() -> None:
    from tests.fuzz.targets import TARGETS

    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("targets", nargs="*", default=list(TARGETS), help=", ".join(TARGETS))
    options.add_argument("--runs", type=int, default=0, help="inputs for each, instead of --seconds")
    options.add_argument("--seconds", type=float, default=5.0)
    options.add_argument("--jobs", type=int, default=1)
    given = options.parse_args()
    kept = Path(tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))

    def run(name: str) -> int:
        (folder := kept / name).mkdir()
        call = f"fuzz_one({name!r}, {given.runs}, {given.seconds}, Path({str(folder)!r}))"
        program = f"from tests.fuzz.__main__ import Path, fuzz_one; {call}"
        done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.STDOUT, stdout=subprocess.PIPE)
        said = done.stdout.decode(errors="replace").splitlines()
        lines = said if done.returncode else [line for line in said if line.startswith(f"{name}: ")]
        print("\n".join(lines[-60:]), flush=True)
        return done.returncode

    with ThreadPoolExecutor(given.jobs) as pool:
        failed = [name for name, code in zip(given.targets, pool.map(run, given.targets)) if code]
    if failed:
        sys.exit(f"{', '.join(failed)}: failed; the inputs are in {kept}")
    shutil.rmtree(kept)


if __name__ == "__main__":
    main()
