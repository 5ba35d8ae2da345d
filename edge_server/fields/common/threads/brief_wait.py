"""Waiting for another thread without sleeping, for about as long as it takes to be woken."""

from __future__ import annotations

import platform
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add_at
from edge_server.fields.field_constants import WAIT_LOOKS

_X86 = platform.machine() in ("x86_64", "AMD64")


@intrinsic
def _pause(typingctx: Any) -> Any:
    """Tell an x86 core that its thread only waits, so that the other thread of the core goes on at full speed."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if _X86:
            void = ir.FunctionType(ir.VoidType(), [])
            builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", (), void), [])
        return context.get_dummy_value()

    return types.void(), codegen


@intrinsic
def _first(typingctx: Any, array: Any) -> Any:
    """The first element of an int64 array, as it is in memory at this moment."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(data, "acquire", 8)

    return types.int64(array), codegen


@kernel
def await_workers(done, workers):
    """Wait until ``done[0]``, which each worker counts up, is ``workers`` or more; give up after ``WAIT_LOOKS``."""
    for _ in range(WAIT_LOOKS):
        if _first(done) >= workers:
            return
        _pause()


@kernel
def await_next_job(done, drawn):
    """Count ``done[0]`` up; then wait until ``drawn[0]`` is reset and a kernel draws from it again, or give up.

    Both without the GIL: a caller or a worker that saw the other's sign while that one holds the GIL would sleep
    for it, which is what the wait is to avoid.
    """
    fetch_add_at(done, 0, 1)
    looks = 0
    while looks < WAIT_LOOKS and _first(drawn) != 0:
        looks += 1
        _pause()
    while looks < WAIT_LOOKS and _first(drawn) == 0:
        looks += 1
        _pause()
