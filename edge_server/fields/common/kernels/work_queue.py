"""Where a pool's threads find work, and tell that it is done, without going to sleep between two kernels.

A thread that sleeps takes tens of microseconds to wake, and a kernel may be done in a hundred. So who has
just computed looks at a board for a while before it sleeps, without the GIL; and who waits for others looks
there, too. Python threads that want the GIL while another holds it sleep as well: therefore nobody answers
a new job before its caller is inside a kernel, which gives the GIL up, and has drawn its first task; or has
had time to.

The board tells of one job: its number (0: there was none yet), whether its caller waits, how many others are
done, and what its kernel counts tasks with (``intrinsics.draw``). Who goes to sleep says so first and then
looks once more for a new number; who offers a job writes its number, last of all, and then looks who sleeps:
one of the two sees the other.
"""

from __future__ import annotations

import platform
import time
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import COUNTER

# Words, each with a cache line of its own, of COUNTER words; so have the states of the workers, and tasks.
NUMBER, WAITS, DONE, COUNTERS = 0, COUNTER, 2 * COUNTER, 3 * COUNTER
NOTHING, WORK, RELEASE = 0, 1, 2
ASLEEP = 1 << 32  # added to DONE by a caller that went to sleep
SEARCH_S = 150e-6  # before a thread sleeps: as long as it takes to wake, a few times
_TRIED = 500  # looks, to learn how long one takes: 50 to 100 ns on x86, where waiting is an instruction
_X86, _ARM = ("x86_64", "AMD64"), ("aarch64", "arm64")


def make_board(threads: int) -> NDArray[np.int64]:
    """int64 (words,), aligned to cache lines."""
    words = COUNTERS + COUNTER * threads
    memory = np.zeros(words + COUNTER, np.int64)
    skip = (-memory.ctypes.data // memory.itemsize) % COUNTER
    return memory[skip : skip + words]


@intrinsic
def _load(typingctx: Any, array: Any, index: Any) -> Any:
    """An element of a contiguous int64 array, as it is at this moment."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "seq_cst", 8)

    return types.int64(array, types.int64), codegen


@intrinsic
def _swap(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write an element; returns what was there."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("xchg", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


@intrinsic
def _add(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Add to an element; returns what was there."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


@intrinsic
def _pause(typingctx: Any) -> Any:
    """Tell the core that it is waiting."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        nothing, number = ir.VoidType(), ir.IntType(32)
        if platform.machine() in _X86:
            kind, name, given = ir.FunctionType(nothing, []), "llvm.x86.sse2.pause", []
            builder.call(cgutils.get_or_insert_function(builder.module, kind, name), given)
        elif platform.machine() in _ARM:
            kind, name, given = ir.FunctionType(nothing, [number]), "llvm.aarch64.hint", [number(1)]
            builder.call(cgutils.get_or_insert_function(builder.module, kind, name), given)
        return context.get_dummy_value()

    return types.none(), codegen


@kernel
def offer(board, number):
    """Tell of a job; the last one is done. Who looks now, or goes to sleep after this, sees it. Returns its
    number."""
    for k in range(WAITS, board.size):
        board[k] = 0
    _swap(board, NUMBER, number)
    # On ARM a plain read may be done before a write that stands before it, but not before this one: else the
    # caller could take for awake who has just gone to sleep.
    return _load(board, NUMBER)


@kernel
def attend(board, states, worker, last, others, looks):
    """What a worker does that has nothing to do, as its state says meanwhile (1, else 0): tell that the job
    ``last`` is done, as one of ``others``, and look ``looks`` times for another. others: 0 if that was told
    before. Returns whether there is WORK or NOTHING, or RELEASE: a caller sleeps and is to be woken first."""
    _swap(states, worker * COUNTER, 1)
    if others > 0 and _add(board, DONE, 1) + 1 == others + ASLEEP:
        _swap(states, worker * COUNTER, 0)
        return RELEASE
    for _ in range(looks):
        if _load(board, NUMBER) != last and (_load(board, COUNTERS) > 0 or _load(board, WAITS) > 0):
            _swap(states, worker * COUNTER, 0)
            return WORK
        _pause()
    _swap(states, worker * COUNTER, 0)
    return WORK if _load(board, NUMBER) != last else NOTHING


@kernel
def await_others(board, others, looks):
    """What a caller does that is done: look whether all others are, ``looks`` times. Returns 1 if they are;
    else 0, and ``attend`` returns RELEASE to the last of them."""
    _swap(board, WAITS, 1)
    for _ in range(looks):
        if _load(board, DONE) == others:
            return 1
        _pause()
    return 1 if _add(board, DONE, ASLEEP) == others else 0


def calls() -> list[tuple[Any, tuple[Any, ...]]]:
    """The kernels above, with arguments such as a pool gives them: to be compiled ahead."""
    board = make_board(1)
    return [(offer, (board, 0)), (attend, (board, board, 0, 0, 0, 0)), (await_others, (board, 0, 0))]


@cache
def looks() -> int:
    """How often a thread looks at a board before it sleeps, on this machine: for ``SEARCH_S``. Compiles the
    kernels above, or loads them: afterwards they do not fail."""
    for one, args in calls():
        one(*args)
    board, states, took_s = make_board(1), make_board(1), 1.0
    for _ in range(5):
        start = time.perf_counter()
        attend(board, states, 0, 0, 0, _TRIED)
        took_s = min(took_s, time.perf_counter() - start)
    # Looking ends with taking the GIL back, which other threads may hold: then it seems to be far slower.
    return max(int(SEARCH_S / took_s * _TRIED), _TRIED) + 1
