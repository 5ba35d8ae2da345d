"""Admits calls to a gRPC server: who may make them, and how many are open at once, also of those that only begin.

Without this, a call whose headers come without a message reaches no handler, and Health/Watch never ends by itself:
a client could open a thousand of either on each connection, at 4 to 30 kB of memory a call.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable
from typing import Any

import grpc
import grpc.aio

from freshfield.access import CALLS, CHANGE, Access, caller
from freshfield.limits import FIRST_MESSAGE_TIMEOUT_S, MAX_CALLS
from freshfield.streams import OpenStreams, ServedCall

_HEALTH = "/grpc.health.v1.Health/"
"""Open to everybody: it only tells that the process works."""


class Admission(grpc.aio.ServerInterceptor):
    """Passes a gRPC call to its handler if the caller may make it. At most MAX_CALLS are open; a new one ends one that
    carried no message, or else the one that carried none for longest."""

    def __init__(self, access: Access) -> None:
        self.calls = OpenStreams(MAX_CALLS)
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
            if not (self._access.open or method.startswith(_HEALTH)):
                await self._check_caller(method, header, context)
            async with self.calls.open(context) as call:
                request = requests if handler.request_streaming else await self._only_message(method, call, context)
                answer = serve(request, context)
                if not inspect.isasyncgen(answer):
                    return await answer
                async for response in answer:
                    await call.write(response)
                return None

        # A stream of requests to gRPC, whatever the method: a handler of a single request is called only after it.
        kind = (
            grpc.stream_stream_rpc_method_handler
            if handler.response_streaming
            else grpc.stream_unary_rpc_method_handler
        )
        return kind(admit, handler.request_deserializer, handler.response_serializer)

    async def _check_caller(self, method: str, header: str | None, context: grpc.aio.ServicerContext) -> None:
        found = self._access.of_certificate(context) if header is None else self._access.of_header(header)
        action = CALLS.get(method, CHANGE)
        if found is None:
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, "no credential, or a wrong one")
            raise AssertionError("abort raises")
        if not found.may(action):
            await context.abort(grpc.StatusCode.PERMISSION_DENIED, f"a {found.role} may not {action}")
        caller.set(found)

    async def _only_message(self, method: str, call: ServedCall, context: grpc.aio.ServicerContext) -> Any:
        message = grpc.aio.EOF
        try:
            async with asyncio.timeout(FIRST_MESSAGE_TIMEOUT_S):
                message = await context.read()
        except TimeoutError:
            pass
        if message is grpc.aio.EOF:
            await context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, "the call began, but no message came")
        if not method.startswith(_HEALTH):
            self.calls.use(call)
        return message
