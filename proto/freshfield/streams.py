"""The streams that a server has open: which one ends for a new one, and to which one a session belongs."""

from __future__ import annotations

import asyncio
import contextlib
from collections import OrderedDict
from collections.abc import AsyncIterator, Iterable, Sequence
from typing import Any

import grpc
import grpc.aio
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from freshfield.access import caller
from freshfield.frame import FrameRejected
from freshfield.limits import MAX_SESSIONS_PER_CAMERA, SESSION_IDLE_NS

# How long a call that is to end waits for the client to take the answer under way.
_TAKEN_S = 0.5


async def serve_health(server: grpc.aio.Server, services: Sequence[str]) -> health.aio.HealthServicer:
    """Add health checks, which say that ``services`` are served, and reflection of them. Before the start."""
    checks = health.aio.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(checks, server)
    reflection.enable_server_reflection((*services, health.SERVICE_NAME, reflection.SERVICE_NAME), server)
    for name in ("", *services):
        await checks.set(name, health_pb2.HealthCheckResponse.SERVING)
    return checks


class ServedCall:
    """``async with`` around the handling of a call: ``end`` ends it from outside. open: until then."""

    def __init__(self, context: grpc.aio.ServicerContext) -> None:
        task = asyncio.current_task()
        assert task is not None
        self.task = task
        self.caller = caller.get()
        self.open = True
        self._context = context
        self._status: tuple[grpc.StatusCode, str] | None = None
        self._writing = False

    def end(self, code: grpc.StatusCode, why: str) -> None:
        """The client is given ``code`` and ``why``, unless it leaves an answer untaken for _TAKEN_S."""
        self._status = code, why
        if self._writing:
            asyncio.get_running_loop().call_later(_TAKEN_S, self._cancel)
        else:
            self.task.cancel()

    async def write(self, answer: Any) -> None:
        """Send an answer. A call that ends in the midst of it could not say why: ``end`` waits for it."""
        self._writing = True
        await self._context.write(answer)
        self._writing = False
        if self._status is not None:
            raise asyncio.CancelledError

    def _cancel(self) -> None:
        if self.open:
            self.task.cancel()

    async def __aenter__(self) -> ServedCall:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        self.open = False
        if self._status is not None and kind is asyncio.CancelledError:
            self.task.uncancel()
            # An answer that the client does not take leaves gRPC no way to say why the call ends.
            with contextlib.suppress(grpc.aio.InternalError):
                await self._context.abort(*self._status)


class OpenStreams:
    """At most ``most`` streams at once. A new one always finds a place, so that whoever opens streams and
    says nothing shuts nobody out: one that never was of use ends for it, the oldest first, or else the one
    whose last use is longest ago.

    ended: number of streams that ended so.
    """

    def __init__(self, most: int) -> None:
        self.ended = 0
        self._most = most
        self._silent: OrderedDict[ServedCall, None] = OrderedDict()
        self._used: OrderedDict[ServedCall, None] = OrderedDict()

    @contextlib.asynccontextmanager
    async def open(self, context: grpc.aio.ServicerContext) -> AsyncIterator[ServedCall]:
        """The call, for as long as it has its place."""
        if len(self._silent) + len(self._used) >= self._most:
            longest_idle, _ = (self._silent or self._used).popitem(last=False)
            longest_idle.end(grpc.StatusCode.RESOURCE_EXHAUSTED, "ended for a new stream: too many are open")
            self.ended += 1
        async with ServedCall(context) as call:
            self._silent[call] = None
            try:
                yield call
            finally:
                self._silent.pop(call, None)
                self._used.pop(call, None)

    def use(self, call: ServedCall) -> None:
        """The stream was of use: it carried a frame that was taken."""
        if call.open and (call in self._silent or call in self._used):
            self._silent.pop(call, None)
            self._used[call] = None
            self._used.move_to_end(call)


class SessionStreams:
    """Which stream sends a session of each camera. Another one may go on with it when that one is closed or
    has been silent for a while: it cannot, in the midst of a session, use up the sequence numbers."""

    def __init__(self, cameras: Iterable[str]) -> None:
        self._sent: dict[str, OrderedDict[str, tuple[ServedCall, int]]] = {c: OrderedDict() for c in cameras}

    def claim(self, camera: str, session: str, call: ServedCall, now_ns: int) -> None:
        """A frame of ``session`` came on the stream ``call``. Raises FrameRejected: forbidden_camera,
        session_in_use."""
        if not call.caller.may_push(camera):
            raise FrameRejected("forbidden_camera", f"this credential is not one of camera {camera}")
        sessions = self._sent[camera]
        owner, last_ns = sessions.get(session, (call, now_ns))
        if owner is not call and owner.open and 0 <= now_ns - last_ns < SESSION_IDLE_NS:
            raise FrameRejected("session_in_use", f"another stream sends session {session} of {camera}")
        sessions[session] = call, now_ns
        sessions.move_to_end(session)
        while len(sessions) > MAX_SESSIONS_PER_CAMERA:
            sessions.popitem(last=False)
