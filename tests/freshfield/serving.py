"""A gRPC server with handlers that a test made, on loopback; why it refuses a call."""

from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager

import grpc
import grpc.aio
import pytest

from freshfield.streams import serve_health
from freshfield.transport import Transport


async def status(call: Awaitable[object]) -> str:
    """Why a call is refused."""
    with pytest.raises(grpc.aio.AioRpcError) as error:
        await call
    return error.value.code().name


@asynccontextmanager
async def serving(transport: Transport, *handlers: grpc.GenericRpcHandler, health: bool = False) -> AsyncIterator[int]:
    """Serves the handlers, and health if asked for; yields the port."""
    server = transport.aio_server()
    server.add_generic_rpc_handlers(handlers)
    if health:
        await serve_health(server, ())
    port = transport.bind(server, "localhost:0")
    await server.start()
    try:
        yield port
    finally:
        await server.stop(None)
