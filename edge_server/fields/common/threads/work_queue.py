"""How a pool's threads find a job, and report that it is done, without sleeping between two kernels.

A thread that sleeps takes tens of microseconds to wake, and a kernel may be done in a hundred. So a thread
that has finished polls the queue for a while, without the GIL, before it sleeps; so does a caller that waits
for the others. Python threads that want the GIL while another one holds it sleep as well: therefore no worker
answers a new job before its caller is inside a kernel, which releases the GIL, and has drawn its first task;
or has had time to.

The queue holds one job: its number (0: none yet), whether its caller waits, how many workers are done, and
the counters from which its kernel draws tasks (``simd.draw``). A thread that goes to sleep says so first and
then checks once more for a new number; a caller writes the number of its job, last of all, and then checks
who sleeps: one of the two sees the other.
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
from edge_server.fields.common.kernels.simd import COUNTER, fetch_add_at

# Words, each with a cache line of its own, of COUNTER words; so have the states of the workers, and tasks.
NUMBER, WAITS, DONE, COUNTERS = 0, COUNTER, 2 * COUNTER, 3 * COUNTER
NOTHING, WORK, WAKE_CALLER = 0, 1, 2
ASLEEP = 1 << 32  # added to DONE by a caller that goes to sleep
POLL_S = 150e-6  # before a thread sleeps: a few times as long as it takes to wake
_TRIED = 500  # polls, to learn how long one takes: 50 to 100 ns on x86, where waiting is an instruction
_X86, _ARM = ("x86_64", "AMD64"), ("aarch64", "arm64")


def make_queue(threads: int) -> NDArray[np.int64]:
    """int64 (words,), aligned to cache lines."""
    words = COUNTERS + COUNTER * threads
    memory = np.zeros(words + COUNTER, np.int64)
    skip = (-memory.ctypes.data // memory.itemsize) % COUNTER
    return memory[skip : skip + words]


@intrinsic
def _load(typingctx: Any, array: Any, index: Any) -> Any:
    """An element of a contiguous int64 array, read atomically."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "seq_cst", 8)

    return types.int64(array, types.int64), codegen


@intrinsic
def _swap(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write an element atomically; returns what was there."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("xchg", builder.gep(data, [args[1]]), args[2], "seq_cst")

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
def post_job(queue, number):
    """Announce a job, once the last one is done. A worker that polls now, or goes to sleep after this, sees
    it. Returns the number."""
    for k in range(WAITS, queue.size):
        queue[k] = 0
    _swap(queue, NUMBER, number)
    # On ARM a plain read may be done before a write that stands before it, but not before this one: else the
    # caller could take a worker for awake that has just gone to sleep.
    return _load(queue, NUMBER)


@kernel
def poll_for_job(queue, states, worker, last, others, polls):
    """Report that job ``last`` is done and poll ``polls`` times for another. The worker's state is 1
    meanwhile, else 0.

    others: how many workers have to report; 0: this one has reported before. Returns WORK or NOTHING, or
    WAKE_CALLER: a caller sleeps and must be woken first.
    """
    _swap(states, worker * COUNTER, 1)
    if others > 0 and fetch_add_at(queue, DONE, 1) + 1 == others + ASLEEP:
        _swap(states, worker * COUNTER, 0)
        return WAKE_CALLER
    for _ in range(polls):
        if _load(queue, NUMBER) != last and (_load(queue, COUNTERS) > 0 or _load(queue, WAITS) > 0):
            _swap(states, worker * COUNTER, 0)
            return WORK
        _pause()
    _swap(states, worker * COUNTER, 0)
    return WORK if _load(queue, NUMBER) != last else NOTHING


@kernel
def await_workers(queue, others, polls):
    """For a caller that has done its share: poll ``polls`` times whether all other workers are done. Returns
    1 if they are; else 0, and ``poll_for_job`` returns WAKE_CALLER to the last of them."""
    _swap(queue, WAITS, 1)
    for _ in range(polls):
        if _load(queue, DONE) == others:
            return 1
        _pause()
    return 1 if fetch_add_at(queue, DONE, ASLEEP) == others else 0


def kernel_calls() -> list[tuple[Any, tuple[Any, ...]]]:
    """The kernels above with arguments of the types that a pool gives them, to be compiled ahead."""
    queue = make_queue(1)
    return [(post_job, (queue, 0)), (poll_for_job, (queue, queue, 0, 0, 0, 0)), (await_workers, (queue, 0, 0))]


@cache
def polls_before_sleep() -> int:
    """How often a thread polls before it sleeps, on this machine: for ``POLL_S``. Compiles or loads the
    kernels above, which cannot fail afterwards."""
    for function, args in kernel_calls():
        function(*args)
    queue, states, took_s = make_queue(1), make_queue(1), 1.0
    for _ in range(5):
        start = time.perf_counter()
        poll_for_job(queue, states, 0, 0, 0, _TRIED)
        took_s = min(took_s, time.perf_counter() - start)
    # Polling ends with taking the GIL back, which other threads may hold: then it seems to be far slower.
    return max(int(POLL_S / took_s * _TRIED), _TRIED) + 1
