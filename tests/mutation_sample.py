"""Draw careless edits from a seed, and see whether the nearest quick tests notice.

    python -m tests.mutation_sample --seed 1 --count 200                 # resumes; hours on two cores

cosmic-ray makes the edits (operators, comparisons, numbers, conditions, loops); this draws a sample of them, spread
over the rooms by lines, and runs for each the tests nearest to the file, for 40 processor seconds: those of its name,
those beside them, those that import it, those above, those that import what imports it. Slow tests are left out. Each
edit is written into a copy of the checkout, where nothing else is changed.

(cosmic-ray by itself runs one command for every edit of a file, in the checkout; mutmut imports everything through
trampolines, which numba cannot compile.)
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2  # noqa: F401 -- loaded once, before the forks
import hypothesis.strategies  # noqa: F401
import numba  # noqa: F401
import pytest
import scipy.stats
import torch  # noqa: F401
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

from edge_server.experiments.engine.engine import ResultStore
from edge_server.fields.common.kernels.jit import cache_folder
from freshfield.files import write_json

ROOT = Path(__file__).resolve().parent.parent
# Folders of sources, and where their tests are.
SOURCES = {
    "proto/freshfield": "tests/freshfield",
    "camera_node": "tests/camera_node",
    "channel_emu": "tests/channel_emu",
    "edge_server": "tests/edge_server",
    "deploy/freshfield_up": "tests/deploy",
}
_SWAPS = {
    "Binary": "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_FloorDiv Pow_Mul BitAnd_BitOr BitOr_BitAnd "
    "LShift_RShift RShift_LShift",
    "Comparison": "Lt_LtE LtE_Lt Gt_GtE GtE_Gt Lt_Gt Gt_Lt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is",
    "Unary": "USub_UAdd Delete_Not",
}
OPERATORS = (
    *(f"core/Replace{kind}Operator_{swap}" for kind, swaps in _SWAPS.items() for swap in swaps.split()),
    *(f"core/Replace{a}With{b}" for a, b in (("True", "False"), ("False", "True"), ("And", "Or"), ("Or", "And"))),
    *(f"core/Replace{a}With{b}" for a, b in (("Break", "Continue"), ("Continue", "Break"))),
    "core/NumberReplacer",
    "core/AddNot",
    "core/ZeroIterationForLoop",
)
# What these hold is not computed with: messages, types, names of modules, what a file does when it is run.
_PASSED_OVER = (ast.Raise, ast.JoinedStr, ast.Assert, ast.Import, ast.ImportFrom)
_SPOKEN = ("print(", "log.", "__name__ ==")
_SELECT = "not slow and not browser and not chaos"
_LIMIT_S = 100.0  # processor seconds of one quick test, or a third of its wall-clock time: kernels may be compiled
_COMPILING_S = 600.0  # with an edit of a kernel, or of a number in it
_COLLECTING = "(collecting)"
_ENOUGH_S, _ENOUGH_OF_ALL_S = 20.0, 40.0  # processor seconds of a group's tests, and of all: those of a far one wait
Span = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Edit:
    """An edit: the ``occurrence``-th that an operator of cosmic-ray makes in a file."""

    file: str
    operator: str
    occurrence: int
    line: int

    def made(self) -> str:
        """The file's text after the edit."""
        made = mutate_code((ROOT / self.file).read_text(), get_operator(self.operator)(), self.occurrence)
        assert made is not None
        return str(made)

    def text(self) -> str:
        """What it changes, for people."""
        before, after = (ROOT / self.file).read_text().splitlines(), self.made().splitlines()
        old, new = next(((a, b) for a, b in zip(before, after) if a != b), ("", ""))
        return f"{self.file}:{self.line}: {old.strip()}  ->  {new.strip()}"


def files() -> list[str]:
    """The source files, generated ones left out."""
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", *SOURCES], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    generated = ("_pb2.py", "_pb2_grpc.py")
    return [name for name in listed if name.endswith(".py") and not name.endswith(generated)]


def room(file: str) -> str:
    """The room of a file: two folders, in experiments three."""
    parts = Path(file).parent.parts
    return "/".join(parts[: 3 if "experiments" in parts else 2])


def places(file: str) -> dict[Span, list[Edit]]:
    """The edits of each place of a file."""
    source = (ROOT / file).read_text()
    passed, nodes = list(_passed_over(ast.parse(source))), list(ast_nodes(get_ast(source)))
    found: dict[Span, list[Edit]] = defaultdict(list)
    for name in OPERATORS:
        operator, occurrence = get_operator(name)(), 0
        for node in nodes:
            for start, end in operator.mutation_positions(node):
                if not any(first <= start and end <= last for first, last in passed):
                    found[start, end].append(Edit(file, name, occurrence, start[0]))
                occurrence += 1
    return found


def _passed_over(tree: ast.AST) -> Iterator[Span]:
    for node in ast.walk(tree):
        spoken = isinstance(node, ast.Call | ast.Compare) and ast.unparse(node).startswith(_SPOKEN)
        skipped: list[Any] = [node] if spoken or isinstance(node, _PASSED_OVER) else []
        skipped += [getattr(node, name, None) for name in ("annotation", "returns")]
        skipped += getattr(node, "decorator_list", [])
        for part in skipped:
            if part is not None:
                yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)


def drawn(seed: int, count: int) -> list[Edit]:
    """``count`` edits: of each room as its share of the lines, a place of its files, then one of the place's edits."""
    lines: dict[str, int] = defaultdict(int)
    of_room: dict[str, list[str]] = defaultdict(list)
    for file in files():
        lines[room(file)] += len((ROOT / file).read_text().splitlines())
        of_room[room(file)].append(file)
    rng, chosen = random.Random(seed), []
    for name, number in _shares(lines, count).items():
        if number:
            every = [edits for file in of_room[name] for _, edits in sorted(places(file).items())]
            chosen += [rng.choice(edits) for edits in rng.sample(every, min(number, len(every)))]
    rng.shuffle(chosen)  # so that a part of them is spread, too
    return chosen


def _shares(lines: dict[str, int], count: int) -> dict[str, int]:
    """``count`` divided in proportion to the lines, by largest remainders."""
    exact = {name: count * n / sum(lines.values()) for name, n in lines.items()}
    found = {name: int(share) for name, share in exact.items()}
    rest = sorted(exact, key=lambda name: found[name] - exact[name])
    for name in rest[: count - sum(found.values())]:
        found[name] += 1
    return found


@cache
def _texts() -> dict[str, str]:
    """Every file of tests, as it stands."""
    return {str(test.relative_to(ROOT)): test.read_text() for test in sorted((ROOT / "tests").rglob("test_*.py"))}


def _importing(file: str) -> re.Pattern[str]:
    """Finds the import of a file in a text."""
    module = file.removeprefix("proto/").removeprefix("deploy/").removesuffix(".py").replace("/", ".")
    parent, _, name = module.rpartition(".")
    return re.compile(rf"\b{re.escape(module)}\b|from {re.escape(parent)} import [^\n]*\b{name}\b")


def nearest_tests(file: str) -> list[list[str]]:
    """Tests to run in turn: those of the file's name, the others of their folder, or of the first folder above that has
    any, those that import the file, those of the folder above within the package, and those that import a file which
    imports it."""
    source = next(folder for folder in SOURCES if file.startswith(f"{folder}/"))
    path = Path(file)
    package = ROOT / SOURCES[source]
    folder = package / path.parent.relative_to(source)
    while not list(folder.glob("test_*.py")):
        folder = folder.parent
    home, above = (str(of.relative_to(ROOT)) for of in (folder, folder.parent if folder != package else folder))
    imports = _importing(file)
    users = [_importing(user) for user in files() if user != file and imports.search((ROOT / user).read_text())]
    groups: list[list[str]] = [[], [], [], [], []]
    for test, text in _texts().items():
        near = str(Path(test).parent)
        ranks = (
            Path(test).stem == f"test_{path.stem}" and near == home,
            near == home,
            imports.search(text),
            near == above,
            any(user.search(text) for user in users),
        )
        for group in (group for group, belongs in zip(groups, ranks) if belongs):
            group.append(test)
            break
    groups[1].sort(key=lambda test: not imports.search(_texts()[test]))
    return [tests[k : k + 8] for tests in groups for k in range(0, len(tests), 8)]  # importing all takes long


class _Watch:
    """Writes down the test that runs, begins none after ``_ENOUGH_S``, and ends the process where one takes too long
    (SIGPROF, SIGALRM)."""

    def __init__(self, note: Path, limit_s: float) -> None:
        self._note, self._limit_s = note, limit_s

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if time.process_time() > (_ENOUGH_S if self._limit_s < _COMPILING_S else _COMPILING_S):
            pytest.exit("enough", returncode=0)
        self._note.write_text(nodeid)
        signal.setitimer(signal.ITIMER_PROF, self._limit_s)
        signal.setitimer(signal.ITIMER_REAL, 3 * self._limit_s)


def failure(copy: Path, tests: Sequence[str], limit_s: float, words: Sequence[str] = ()) -> str | None:
    """The first test that fails in the copy or takes longer than the limit, in a fork that has all libraries. words:
    further ones for pytest."""
    note = copy / "runs-now.txt"
    note.write_text(_COLLECTING)
    child = os.fork()
    if not child:
        os.setsid()
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        for number in (signal.SIGPROF, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 3 * limit_s)
        os.chdir(copy)
        sys.path[:0] = [str(copy / part) for part in ("proto", "", "deploy")]
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path[:3])
        ours = {"tests", "freshfield", "camera_node", "channel_emu", "edge_server", "freshfield_up"}
        for name in [name for name in sys.modules if name.partition(".")[0] in ours]:
            del sys.modules[name]
        options = ["-qx", "-m", _SELECT, "-p", "no:cacheprovider", "-p", "no:randomly"]
        code = pytest.main([*options, *words, *tests], plugins=[_Watch(note, limit_s)])
        os._exit(0 if code in (0, 5) else 1)  # 5: none is quick
    code = os.waitpid(child, 0)[1]
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what a test left behind
    return note.read_text() if code else None


class Runner:
    """Runs edits in a copy of the checkout, always at the same place: compiled kernels are kept by place."""

    def __init__(self, copy: Path) -> None:
        self.copy = copy
        shutil.rmtree(copy, ignore_errors=True)
        listed = subprocess.run(["git", "-C", str(ROOT), "ls-files"], capture_output=True, text=True, check=True).stdout
        for name in listed.splitlines():
            if (ROOT / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, copy / name)
        self._kernels = cache_folder(copy / "edge_server")
        self._fails = cache(lambda test: failure(self.copy, [test], _COMPILING_S) is not None)
        self._uncollected = cache(lambda tests: failure(self.copy, tests, _LIMIT_S, ["--collect-only"]) is not None)
        self._compiled = cache(lambda tests: failure(self.copy, tests, _COMPILING_S, self._without()))
        self._broken: list[str] = []

    def outcome(self, edit: Edit) -> dict[str, Any]:
        """{caught_by: a test that fails with the edit and passes without it, or None; broken: tests that fail in both
        cases}."""
        broken: list[str] = []
        begun_s = os.times().children_user
        for tests in nearest_tests(edit.file):
            if os.times().children_user - begun_s > _ENOUGH_OF_ALL_S:
                break
            while found := self._failure(edit, tests):
                fails = self._uncollected(tuple(tests)) if found == _COLLECTING else self._fails(found)
                if not fails:
                    return {"caught_by": found, "broken": broken}
                broken.append(found)
                if found == _COLLECTING:
                    break
                self._broken.append(found)
        return {"caught_by": None, "broken": broken}

    def _without(self) -> list[str]:
        return [f"--deselect={test}" for test in self._broken]

    def _failure(self, edit: Edit, tests: list[str]) -> str | None:
        compiles = "/kernels/" in edit.file or ("/fields/" in edit.file and edit.file.endswith("settings.py"))
        if compiles:
            self._compiled(tuple(tests))
        (self.copy / edit.file).write_text(edit.made())
        changed = cache_folder(self.copy / "edge_server")
        try:
            if changed != self._kernels and self._kernels.is_dir():
                shutil.copytree(self._kernels, changed, dirs_exist_ok=True)
                for module in _inlining(edit.file):
                    for kept in changed.rglob(f"{module}.*.nbi"):
                        kept.unlink()
            return failure(self.copy, tests, _COMPILING_S if compiles else _LIMIT_S, self._without())
        finally:
            shutil.copy2(ROOT / edit.file, self.copy / edit.file)
            if changed != self._kernels:
                shutil.rmtree(changed, ignore_errors=True)


def _inlining(file: str) -> set[str]:
    """Names of the modules of kernels that import a file, and that import those."""
    kernels = {path: path.read_text() for path in (ROOT / "edge_server").rglob("kernels/*.py")}
    known, stems = {Path(file).stem}, {Path(file).stem}
    while known:
        imports = re.compile(rf"^(from|import) .*\b({'|'.join(known)})\b", re.MULTILINE)
        known = {path.stem for path, text in kernels.items() if imports.search(text)} - stems
        stems |= known
    return stems


def share(caught: int, total: int) -> str:
    """The caught share with its 95 % interval (Wilson)."""
    if not total:
        return "nothing was run"
    low, high = scipy.stats.binomtest(caught, total).proportion_ci(method="wilson")
    return f"{caught} of {total} caught: {caught / total:.1%} [{low:.1%}, {high:.1%}]"


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns 1 if an edit survives."""
    parser = argparse.ArgumentParser("mutation_sample", None, __doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--seed", type=int, default=1, help="seed of the sample [%(default)s]")
    add("--count", type=int, default=200, help="number of edits [%(default)s]")
    add("--json", type=Path, metavar="FILE", help="file to write the counts and the survivors to")
    add("--out", type=Path, default="runs/mutants.jsonl", metavar="FILE", help="where results are kept [%(default)s]")
    args = parser.parse_args(argv)
    store, outcomes, runner = ResultStore(args.out), [], None
    for number, edit in enumerate(drawn(args.seed, args.count)):
        source = hashlib.sha256((ROOT / edit.file).read_bytes()).hexdigest()[:16]
        key = f"{source} {edit.file} {edit.operator} {edit.occurrence}"
        if key not in store.results:
            runner = runner or Runner(args.out.with_suffix("").resolve())
            store.put(key, {**asdict(edit), "text": edit.text()}, runner.outcome(edit))
        found = store.results[key]
        word = "SURVIVED" if found["caught_by"] is None else "caught"
        note = f" (fail without it: {', '.join(found['broken'])})" if found["broken"] else ""
        print(f"{number:3} {word:8} {edit.text()}{note}", flush=True)
        outcomes.append((edit, found["caught_by"] is not None))
    print(f"\nsurvivors of seed {args.seed}:")
    for edit, _ in (one for one in outcomes if not one[1]):
        print(f"  {edit.text()}")
    for name in sorted({room(edit.file) for edit, _ in outcomes}):
        of = [caught for edit, caught in outcomes if room(edit.file) == name]
        print(f"{name:40} {sum(of)} of {len(of)}")
    caught = sum(was for _, was in outcomes)
    if args.json is not None:
        survivors = [edit.text() for edit, was in outcomes if not was]
        about = {"seed": args.seed, "drawn": args.count, "judged": len(outcomes), "caught": caught}
        write_json(args.json, {**about, "survivors": survivors}, indent=1)
    print(share(caught, len(outcomes)))
    return int(caught < len(outcomes))


if __name__ == "__main__":
    sys.exit(main())
