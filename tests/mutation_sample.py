"""Draw careless edits from a seed, and see whether the nearest quick tests notice.

    python -m tests.mutation_sample --seed 1 --count 200                 # resumes; hours on two cores

cosmic-ray makes the edits (operators, comparisons, conditions, loops, numbers; those that change one by less than a
fifth are left out); this draws a sample of them, spread over the files by lines, and runs for each the tests nearest
to the file, for 40 processor seconds: those of its name, those beside them, those that import it, those above; then
those of the documentation, which says keys, bounds, defaults. Slow tests are left out. Each edit is written into a
copy of the checkout, where nothing else is changed.

(cosmic-ray by itself runs one command for every edit of a file, in the checkout; mutmut imports everything through
trampolines, which numba cannot compile.)
"""

import argparse
import ast
import contextlib
import hashlib
import io
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import scipy.stats
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
    *(f"core/Replace{a}" for a in ("TrueWithFalse", "FalseWithTrue", "AndWithOr", "OrWithAnd")),
    *("core/ReplaceBreakWithContinue", "core/ReplaceContinueWithBreak"),
    *("core/NumberReplacer", "core/AddNot", "core/ZeroIterationForLoop"),
)
# What these hold is not computed with: messages, types, names of modules, what a file does when it is run.
_PASSED_OVER = (ast.Raise, ast.JoinedStr, ast.Assert, ast.Import, ast.ImportFrom)
_SPOKEN = ("print(", "log.", "__name__ ==")
_SELECT = "not slow and not browser and not chaos"
_LIMIT_S = 120.0  # of one quick test, and of a group of them; no more begin after that
_COMPILING_S = 600.0  # with an edit of a kernel, or of a number in it
_ENDED = "(the process)"  # failed, but no test did: in a loop of compiled code, for instance
_ENOUGH_S = 40.0  # processor seconds of all tests: those of a far group wait
_DOCS = "tests/deploy/test_docs.py"
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


def tracked(*folders: str) -> list[str]:
    """The files below ``folders``, or all, that git knows."""
    return subprocess.check_output(["git", "-C", str(ROOT), "ls-files", *folders], text=True).splitlines()


def files() -> list[str]:
    """The source files, generated ones left out."""
    generated = ("_pb2.py", "_pb2_grpc.py")
    return [name for name in tracked(*SOURCES) if name.endswith(".py") and not name.endswith(generated)]


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
    """``count`` edits: of a file, the longer the likelier, a place, then one of the place's edits."""
    lines = {file: len((ROOT / file).read_text().splitlines()) for file in files()}
    rng, of, chosen = random.Random(seed), cache(places), dict[Edit, None]()
    while len(chosen) < count:
        (file,) = rng.choices([*lines], [*lines.values()])
        if of(file):
            edit = rng.choice(of(file)[rng.choice(sorted(of(file)))])
            if not _slight(edit):
                chosen[edit] = None
    return [*chosen]


def _slight(edit: Edit) -> bool:
    """Whether it changes a number by less than a fifth. Whether 50 ppm or 51 are right no test should say."""
    if edit.operator != "core/NumberReplacer":
        return False
    texts = ((ROOT / edit.file).read_text(), edit.made())
    tokens = (tokenize.generate_tokens(io.StringIO(text).readline) for text in texts)
    old, new = next((a.string, b.string) for a, b in zip(*tokens) if a.string != b.string)
    return new[0].isdigit() and abs(ast.literal_eval(old) - ast.literal_eval(new)) < 0.2 * ast.literal_eval(old)


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
    any, those that import the file, those of the folder above within the package, and those of the documentation."""
    source = next(folder for folder in SOURCES if file.startswith(f"{folder}/"))
    path = Path(file)
    package = ROOT / SOURCES[source]
    folder = package / path.parent.relative_to(source)
    while not list(folder.glob("test_*.py")):
        folder = folder.parent
    above, imports = folder.parent if folder != package else folder, _importing(file)
    groups: list[list[str]] = [[], [], [], [], []]
    for test, text in _texts().items():
        near = (ROOT / test).parent
        named, beside, importing = Path(test).stem == f"test_{path.stem}", near == folder, imports.search(text)
        ranks = (beside and named, beside and importing, beside, importing, near == above)
        for group in [group for group, belongs in zip(groups, ranks) if belongs][:1]:
            group.append(test)
    found = [tests[k : k + 8] for tests in groups for k in range(0, len(tests), 8)]  # importing all takes long
    return [*found, [_DOCS]]


def failure(copy: Path, words: Sequence[str], limit_s: float) -> str | None:
    """The first test that fails in the copy, or takes longer than the limit. words: tests, and options of pytest."""
    options = ["-qx", "-m", _SELECT, "-p", "no:cacheprovider", f"--timeout={limit_s}", f"--session-timeout={limit_s}"]
    paths = os.pathsep.join(str(copy / part) for part in ("proto", "", "deploy"))
    command = [sys.executable, "-m", "pytest", *options, *words]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True, "start_new_session": True}
    pytest = subprocess.Popen(command, cwd=copy, env={**os.environ, "PYTHONPATH": paths}, **piped)
    try:
        said, _ = pytest.communicate(timeout=3 * limit_s)
    except subprocess.TimeoutExpired:
        return _ENDED  # it waits in compiled code, where no signal ends a test
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pytest.pid, signal.SIGKILL)  # and what its tests have started
    found = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", said, re.MULTILINE)
    if found is not None:
        return found[1]
    return None if pytest.wait() in (0, 5) or "session-timeout" in said else _ENDED  # 5: none is quick


def copy_checkout(copy: Path) -> None:
    """Where edits run, always at the same place: compiled kernels are kept by place."""
    shutil.rmtree(copy, ignore_errors=True)
    for name in tracked():
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)


@cache
def _fails(copy: Path, test: str) -> bool:
    """Whether a test fails without an edit."""
    return failure(copy, [test], _COMPILING_S) is not None


def caught_by(copy: Path, edit: Edit, broken: list[str]) -> str | None:
    """A test that fails with the edit and passes without it, or None. broken: tests that fail without any; added to."""
    inlined = edit.file.endswith(("settings.py", "_constants.py"))
    compiles = "/kernels/" in edit.file or ("/fields/" in edit.file and inlined)
    limit_s, enough_s = (_COMPILING_S, _COMPILING_S) if compiles else (_LIMIT_S, _ENOUGH_S)
    begun_s = os.times().children_user
    for tests in nearest_tests(edit.file):
        if os.times().children_user - begun_s > enough_s and tests != [_DOCS]:
            continue
        while (
            found := _failure(copy, edit, [*(f"--deselect={test}" for test in broken), *tests], limit_s)
        ) is not None:
            if found == _ENDED or found in broken or not _fails(copy, found):
                return found
            broken.append(found)
    return None


def _failure(copy: Path, edit: Edit, words: list[str], limit_s: float) -> str | None:
    (copy / edit.file).write_text(edit.made())
    kernels = cache_folder(copy / "edge_server")
    try:
        return failure(copy, words, limit_s)
    finally:
        shutil.copy2(ROOT / edit.file, copy / edit.file)
        if kernels != cache_folder(copy / "edge_server"):
            shutil.rmtree(kernels, ignore_errors=True)


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns 1 if an edit survives."""
    parser = argparse.ArgumentParser("mutation_sample", None, __doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--seed", type=int, default=1, help="seed of the sample [%(default)s]")
    add("--count", type=int, default=200, help="number of edits [%(default)s]")
    add("--json", type=Path, metavar="FILE", help="file to write the counts and the survivors to")
    add("--out", type=Path, default="runs/mutants.jsonl", metavar="FILE", help="where results are kept [%(default)s]")
    args = parser.parse_args(argv)
    store, copy, survivors, broken = ResultStore(args.out), args.out.with_suffix("").resolve(), [], []
    copy_checkout(copy)
    for number, edit in enumerate(drawn(args.seed, args.count)):
        source = hashlib.sha256((ROOT / edit.file).read_bytes()).hexdigest()[:16]
        key = f"{source} {edit.file} {edit.operator} {edit.occurrence}"
        if key not in store.results:
            store.put(key, {**asdict(edit), "text": edit.text()}, caught_by(copy, edit, broken))
        print(f"{number:3} {'SURVIVED' if store.results[key] is None else 'caught':8} {edit.text()}", flush=True)
        survivors += [edit.text()] * (store.results[key] is None)
    print("\n  ".join(["\nsurvivors:", *survivors]))
    caught = args.count - len(survivors)
    if args.json is not None:
        write_json(args.json, {"seed": args.seed, "drawn": args.count, "caught": caught, "survivors": survivors}, 1)
    low, high = scipy.stats.binomtest(caught, args.count).proportion_ci(method="wilson")
    print(f"{caught} of {args.count} caught: {caught / args.count:.1%} [{low:.1%}, {high:.1%}]")  # 95 %
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
