"""The open calls of a server: who may make one, which one is ended to admit a new one, and which one owns a session.

Without ``Admission``, a call that sends headers but no message never reaches a handler, and Health/Watch never ends:
a client could open a thousand of either on each connection, at 4 to 30 kB of memory per call.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextvars import ContextVar
from typing import Any

import grpc
import grpc.aio
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from freshfield.access import CALLS, CHANGE, Access, caller
from freshfield.frame import FrameRejected
from freshfield.limits import FIRST_MESSAGE_TIMEOUT_S, MAX_SESSIONS_PER_CAMERA, SESSION_IDLE_NS

# How long ``end`` waits for the client to take an answer that is being written.
_TAKEN_S = 0.5
_HEALTH = "/grpc.health.v1.Health/"  # open to everybody: it only reports whether the process works


async def serve_health(server: grpc.aio.Server, services: Sequence[str]) -> health.aio.HealthServicer:
    """Add the health service, which reports ``services`` as serving, and reflection. Call before the server
    starts."""
    checks = health.aio.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(checks, server)
    reflection.enable_server_reflection((*services, health.SERVICE_NAME, reflection.SERVICE_NAME), server)
    for name in ("", *services):
        await checks.set(name, health_pb2.HealthCheckResponse.SERVING)
    return checks


def refuse(context: grpc.aio.ServicerContext, code: grpc.StatusCode, why: str) -> None:
    """End a call whose handler now returns. ``context.abort`` would keep its exception, and with it the call's memory
    (8 kB), until the garbage collector runs."""
    context.set_code(code)
    context.set_details(why)


class ServedCall:
    """Async context around the handling of a call, which ``end`` can end from another task. Contexts nested in one task
    are the same object: see ``of``.

    open: whether the context has not been left yet.
    """

    def __init__(self, context: grpc.aio.ServicerContext) -> None:
        task = asyncio.current_task()
        assert task is not None
        self.task = task
        self.caller = caller.get()
        self.open = True
        self._context = context
        self._status: tuple[grpc.StatusCode, str] | None = None
        self._writing = False
        self.held_in: list[OpenStreams] = []
        """The collections that hold a place for the call."""

    @staticmethod
    @contextlib.asynccontextmanager
    async def of(context: grpc.aio.ServicerContext) -> AsyncIterator[ServedCall]:
        """The call that the current task serves, within a context of its own if there is none yet."""
        call = _served.get()
        if call is not None:
            yield call
            return
        async with ServedCall(context) as call:
            _served.set(call)
            yield call

    def use(self) -> None:
        """Mark the call as used, wherever it is held: it carried a message that was accepted."""
        for streams in self.held_in:
            streams.note_use(self)

    def end(self, code: grpc.StatusCode, why: str) -> None:
        """End the call. The client receives ``code`` and ``why``, unless an answer that is being written is
        not taken within _TAKEN_S."""
        self._status = code, why
        if self._writing:
            asyncio.get_running_loop().call_later(_TAKEN_S, self._cancel)
        else:
            self.task.cancel()

    async def write(self, answer: Any) -> None:
        """Send an answer, as ``send`` does."""
        await self.send(self._context.write, answer)

    async def send(self, operation: Callable[..., Awaitable[None]], *arguments: Any) -> None:
        """Await ``operation`` of the context, which sends an answer or the initial metadata. ``end`` waits for it: a
        call cancelled while it sends cannot send a status, and its client waits without end."""
        if self._status is None:
            self._writing = True
            await operation(*arguments)
            self._writing = False
        if self._status is not None:
            raise asyncio.CancelledError

    def _cancel(self) -> None:
        if self.open:
            self.task.cancel()

    async def __aenter__(self) -> ServedCall:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: Any) -> bool:
        self.open = False
        if self._status is None or kind is not asyncio.CancelledError:
            return False
        self.task.uncancel()
        refuse(self._context, *self._status)
        return True


_served: ContextVar[ServedCall | None] = ContextVar("served", default=None)


class OpenStreams:
    """Admits at most ``most`` streams at once. A new stream is always admitted, so a client that opens idle
    streams cannot shut others out. To make room, the oldest stream that was never used is ended, or else the
    least recently used one.

    ended: number of streams ended to make room.
    """

    def __init__(self, most: int) -> None:
        self.ended = 0
        self._closed: str | None = None
        self._most = most
        self._silent: OrderedDict[ServedCall, None] = OrderedDict()
        self._used: OrderedDict[ServedCall, None] = OrderedDict()

    @contextlib.asynccontextmanager
    async def open(self, context: grpc.aio.ServicerContext) -> AsyncIterator[ServedCall]:
        """Admit the call of ``context`` and hold its place within the ``async with`` block."""
        if len(self._silent) + len(self._used) >= self._most:
            longest_idle, _ = (self._silent or self._used).popitem(last=False)
            longest_idle.end(grpc.StatusCode.RESOURCE_EXHAUSTED, "ended for a new stream: too many are open")
            self.ended += 1
        async with ServedCall.of(context) as call:
            self._silent[call] = None
            call.held_in.append(self)
            try:
                if self._closed is not None:  # it opens between ``end_all`` and the server's stop
                    call.end(grpc.StatusCode.UNAVAILABLE, self._closed)
                    await asyncio.sleep(0)  # is cancelled here, and ends in ``Admission``, before it writes anything
                yield call
            finally:
                self._silent.pop(call, None)
                self._used.pop(call, None)

    def end_all(self, why: str) -> None:
        """End every stream, and each that opens from now on, before the server stops. gRPC would cancel them and
        print a traceback for each."""
        self._closed = why
        for call in [*self._silent, *self._used]:
            call.end(grpc.StatusCode.UNAVAILABLE, why)

    def note_use(self, call: ServedCall) -> None:
        """See ``ServedCall.use``."""
        if call.open and (call in self._silent or call in self._used):
            self._silent.pop(call, None)
            self._used[call] = None
            self._used.move_to_end(call)


class SessionStreams:
    """Knows which stream sends each session of each camera. Another stream may continue the session only
    after the owner closed or was silent for SESSION_IDLE_NS; otherwise it could use up sequence numbers in
    the middle of a session."""

    def __init__(self, cameras: Iterable[str]) -> None:
        self._sent: dict[str, OrderedDict[str, tuple[ServedCall, int]]] = {c: OrderedDict() for c in cameras}

    def claim(self, camera: str, session: str, call: ServedCall, now_ns: int) -> None:
        """Record that a frame of ``session`` came on the stream ``call``.

        Raises FrameRejected with reason forbidden_camera (the caller may not push it) or session_in_use.
        """
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


class Admission(grpc.aio.ServerInterceptor):
    """Passes a gRPC call to its handler if the caller may make it. At most ``most`` are open; a new one ends a call
    that carried no message, or else the one idle for longest."""

    def __init__(self, access: Access, most: int) -> None:
        self.calls = OpenStreams(most)
        self._access = access

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler:
        method = handler_call_details.method
        header = dict(handler_call_details.invocation_metadata or ()).get("authorization")
        handler = await continuation(handler_call_details)
        if handler is None:
            return handler
        serve = handler.unary_unary or handler.unary_stream or handler.stream_unary or handler.stream_stream

        async def admit(requests: Any, context: grpc.aio.ServicerContext) -> Any:
            if not (self._access.open or method.startswith(_HEALTH) or self._let_in(method, header, context)):
                return None
            async with self.calls.open(context) as call:
                request = requests
                if not handler.request_streaming:
                    request = await _only_message(context)
                    if request is grpc.aio.EOF:
                        return refuse(context, grpc.StatusCode.DEADLINE_EXCEEDED, "the call began, but no message came")
                    if not method.startswith(_HEALTH):
                        call.use()
                answer = serve(request, context)
                if not inspect.isasyncgen(answer):
                    return await answer
                async for response in answer:
                    await call.write(response)
                return None

        # Registered as request streaming whatever the method: gRPC calls a unary handler only once its message came.
        kind = (
            grpc.stream_stream_rpc_method_handler
            if handler.response_streaming
            else grpc.stream_unary_rpc_method_handler
        )
        return kind(admit, handler.request_deserializer, handler.response_serializer)

    def _let_in(self, method: str, header: str | None, context: grpc.aio.ServicerContext) -> bool:
        """Whether the caller may make the call; otherwise it is refused."""
        found = self._access.of_certificate(context) if header is None else self._access.of_header(header)
        action = CALLS.get(method, CHANGE)
        if found is None:
            refuse(context, grpc.StatusCode.UNAUTHENTICATED, "no credential, or a wrong one")
            return False
        if not found.may(action):
            refuse(context, grpc.StatusCode.PERMISSION_DENIED, f"a {found.role} may not {action}")
            return False
        caller.set(found)
        return True


async def _only_message(context: grpc.aio.ServicerContext) -> Any:
    """The single message of a unary call; EOF if it does not arrive in time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(FIRST_MESSAGE_TIMEOUT_S):
            return await context.read()
    return grpc.aio.EOF
