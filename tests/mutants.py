"""Change one operator or constant at a time and see whether the tests of that module notice.

    python -m tests.mutants --seed 1 --count 100        # some 40 minutes on one core
    python -m tests.mutants --seed 1 --count 100 --only 7,31

The mutants are drawn from MODULES, as many from each group, by the seed; each is written into a copy of the
checkout. One that no test notices within its time survives: a sharper test is due, or it changes nothing that
anybody can see. (cosmic-ray changes the checkout itself and wants a configuration for each set of tests;
mutmut imports everything through trampolines, which numba cannot compile.)
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2  # noqa: F401
import hypothesis.strategies  # noqa: F401
import numba  # noqa: F401
import pytest
import torch  # noqa: F401

ROOT = Path(__file__).resolve().parent.parent
FIELDS, SCHEDULER, FIDELITY = (f"edge_server/{room}" for room in ("fields", "scheduler", "fidelity"))
# By group: files, and the tests that speak for them.
MODULES = {
    "fields": (  # what learns takes minutes a test, too long for a mutant
        [f"{FIELDS}/checkpoint.py", f"{FIELDS}/common/scene_box.py", f"{FIELDS}/common/supervision.py"],
        [
            f"tests/{FIELDS}/{name}.py"
            for name in ("test_checkpoint", "common/test_scene_box", "common/test_supervision")
        ],
    ),
    "link": (
        ["channel_emu/model/link.py", "channel_emu/model/queue_server.py"],
        ["tests/channel_emu/model/test_link.py", "tests/channel_emu/model/test_queue_server.py"],
    ),
    "buffer": (["edge_server/live/buffer.py"], ["tests/edge_server/live/test_buffer.py"]),
    "scheduler": (
        [f"{SCHEDULER}/{name}.py" for name in ("fixed", "policy", "registry", "wait")],
        [f"tests/{SCHEDULER}/test_policies.py", f"tests/{SCHEDULER}/test_registry.py"],
    ),
    "fidelity": (
        [f"{FIDELITY}/{name}.py" for name in ("baselines", "images", "moving_pixels", "psnr", "scorer", "ssim")],
        [f"tests/{FIDELITY}/test_{name}.py" for name in ("baselines", "moving_pixels", "psnr", "scorer", "ssim")],
    ),
    "ledger": (["proto/freshfield/ledger.py"], ["tests/freshfield/test_ledger.py"]),
}
SWAPS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
}
# What these hold is not computed with: messages, names of types.
PASSED_OVER = (ast.Raise, ast.JoinedStr, ast.AnnAssign, ast.Assert, ast.Import, ast.ImportFrom)


def places(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes that ``mutate`` can change, in the order of the source."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, PASSED_OVER):
                continue
            if mutate(copy.deepcopy(child)):
                yield child
            yield from places(child)


def mutate(node: ast.AST) -> bool:
    """Change a node in place; False where there is nothing to change."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        node.ops[0] = SWAPS[type(node.ops[0])]()
    elif isinstance(node, ast.BoolOp | ast.BinOp | ast.AugAssign) and type(node.op) in SWAPS:
        node.op = SWAPS[type(node.op)]()
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        node.value = not node.value if isinstance(node.value, bool) else node.value + 1
    elif isinstance(node, ast.If | ast.IfExp):
        node.test = ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        node.value = ast.Constant(None)  # type: ignore[arg-type]
    else:
        return False
    return True


def drawn(seed: int, count: int) -> list[tuple[str, str, int]]:
    """(group, file, number of the place in it), as many of each group."""
    rng, chosen = random.Random(seed), []
    for number, (group, (files, _)) in enumerate(MODULES.items()):
        every = [(group, f, k) for f in files for k, _ in enumerate(places(ast.parse((ROOT / f).read_text())))]
        chosen += rng.sample(every, min(len(every), (count + number) // len(MODULES)))
    return chosen


def passes(copy_of: Path, group: str, limit_s: float) -> bool:
    """Whether the group's tests pass in the copy within the time, in a fork that has all libraries."""
    until_s = time.monotonic() + limit_s
    child = os.fork()
    if not child:
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        os.chdir(copy_of)
        sys.path[:0] = [str(copy_of / part) for part in ("proto", "", "deploy")]
        for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
            del sys.modules[name]
        os._exit(pytest.main(["-qx", "-m", "not slow", "-p", "no:cacheprovider", *MODULES[group][1]]))
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > until_s:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.05)
    return ended[1] == 0


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--count", type=int, default=100)
    options.add_argument("--only", type=lambda text: [int(n) for n in text.split(",")], help="their numbers")
    given = options.parse_args()
    killed = survived = 0
    limits_s: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        copy_of = Path(folder) / "tree"
        shutil.copytree(ROOT, copy_of, ignore=shutil.ignore_patterns(".*", "runs", "docs", "__pycache__"))
        for number, (group, file, place) in enumerate(drawn(given.seed, given.count)):
            if given.only is not None and number not in given.only:
                continue
            if group not in limits_s:  # once to compile, once for the time
                assert passes(copy_of, group, 900), f"the tests of {group} fail without any change"
                begun = time.monotonic()
                passes(copy_of, group, 900)
                limits_s[group] = 30 + 5 * (time.monotonic() - begun)
            tree = ast.parse((ROOT / file).read_text())
            node = list(places(tree))[place]
            before = ast.unparse(node).split("\n")[0]
            mutate(node)
            (copy_of / file).write_text(ast.unparse(ast.fix_missing_locations(tree)))
            lives = passes(copy_of, group, limits_s[group])
            shutil.copy(ROOT / file, copy_of / file)
            killed, survived = killed + (not lives), survived + lives
            after, verdict = ast.unparse(node).split("\n")[0], "SURVIVED" if lives else "killed"
            print(f"{number:3} {verdict} {file}:{node.lineno}: {before}  ->  {after}", flush=True)  # type: ignore[attr-defined]
    print(f"{killed + survived} mutants, {killed} killed, {survived} survived")
    sys.exit(survived > 0)


if __name__ == "__main__":
    main()
