"""gRPC channels and servers as every process of the project opens them: limits, keepalive, TLS, tokens.

``grpc.http2.bdp_probe=0``: with bandwidth probing, a client can queue megabytes of frames behind a stalled
reader, which makes them old. Keepalive is set at both ends, because servers close connections whose pings
they did not agree to.
"""

from __future__ import annotations

import argparse
import logging
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import numpy as np

from freshfield.access import Access, is_loopback, parse_tokens
from freshfield.limits import (
    GRPC_IDLE_S,
    MAX_CALLS,
    MAX_CONCURRENT_STREAMS,
    MAX_GRPC_CONNECTIONS,
    MAX_MESSAGE_BYTES,
    MAX_PEER_TEXT_CHARS,
    MAX_PENDING_CALLS,
    TLS_HANDSHAKE_TIMEOUT_S,
)
from freshfield.streams import Admission
from freshfield.untrusted import read_bytes

log = logging.getLogger(__name__)

_KEEPALIVE_MS = 10_000

_COMMON: list[tuple[str, Any]] = [
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    ("grpc.http2.bdp_probe", 0),
    ("grpc.keepalive_time_ms", _KEEPALIVE_MS),
    ("grpc.keepalive_timeout_ms", 5_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
]
CLIENT_OPTIONS = [
    *_COMMON,
    # Senders pause by ``backoff_s``; gRPC's own back-off would add up to two minutes.
    ("grpc.initial_reconnect_backoff_ms", 200),
    ("grpc.min_reconnect_backoff_ms", 200),
    ("grpc.max_reconnect_backoff_ms", 1_000),
    ("grpc.enable_http_proxy", 0),
]
SERVER_OPTIONS = [
    *_COMMON,
    # Without bandwidth probing the window stays at 64 kB, and a receiver that is not scheduled for a moment
    # blocks every camera on the connection (p99 of the emulator's delay error 10 to 35 ms instead of 1).
    # Queueing is bounded by the streams' credits, not by this window.
    ("grpc.http2.lookahead_bytes", 1 << 20),
    ("grpc.http2.min_ping_interval_without_data_ms", _KEEPALIVE_MS // 2),
    ("grpc.server.max_pending_requests", MAX_PENDING_CALLS),
    ("grpc.server.max_pending_requests_hard_limit", MAX_PENDING_CALLS * 3 // 2),
    ("grpc.server_handshake_timeout_ms", round(TLS_HANDSHAKE_TIMEOUT_S * 1e3)),
    ("grpc.max_allowed_incoming_connections", MAX_GRPC_CONNECTIONS),
    ("grpc.max_connection_idle_ms", round(GRPC_IDLE_S * 1e3)),
    # Two servers silently sharing one port would split the cameras between them.
    ("grpc.so_reuseport", 0),
]


def backoff_s(failures: int, first_s: float, max_s: float, jitter: np.random.Generator) -> float:
    """Pause in seconds before a stream is opened again: doubled with every failure, times 0.5 to 1.

    failures: failed attempts since the stream last worked, from 0.
    first_s: pause at 0 failures, before jitter. max_s: largest pause, before jitter.
    jitter: source of the factor, so that the cameras do not all reconnect at once.
    """
    return min(first_s * 2.0 ** min(failures, 60), max_s) * float(jitter.uniform(0.5, 1.0))


def peer_text(text: str | None) -> str:
    """A peer's text made safe for a log: one line, control characters escaped, truncated."""
    return repr((text or "")[:MAX_PEER_TEXT_CHARS])[1:-1]


class TransportError(ValueError):
    """A security or address option that cannot work; the message says what to change."""


def host_port(text: str) -> tuple[str, int]:
    """Parse ``HOST:PORT`` with a port from 0 to 65535.

    An IPv6 host is given in brackets and returned with them; no host means 127.0.0.1.
    Raises TransportError.
    """
    host, colon, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    # isdigit alone accepts superscripts, and int() raises its own error for a very long number.
    numeric = port.isascii() and port.isdigit() and len(port) <= 5 and int(port) < 65536
    if not colon or not numeric or any(c.isspace() or c == "/" for c in host) or (":" in host) != bracketed:
        raise TransportError(f"expected HOST:PORT, such as 127.0.0.1:7001 or [::1]:7001, got {text!r}")
    return host or "127.0.0.1", int(port)


def socket_address(text: str) -> tuple[str, int]:
    """As ``host_port``, the host as sockets take it: an IPv6 one without brackets."""
    host, port = host_port(text)
    return host.removeprefix("[").removesuffix("]"), port


def peer(option: str, text: str) -> str:
    """Check HOST:PORT of a peer to connect to (port from 1). option: named in the TransportError raised."""
    try:
        host, port = host_port(text)
    except TransportError as error:
        raise TransportError(f"{option}: {error}") from None
    if port == 0:
        raise TransportError(f"{option}: expected HOST:PORT with a port from 1, got {text!r}")
    return f"{host}:{port}"


@dataclass(frozen=True)
class Transport:
    """Security of this process's connections. Without ``cert`` and ``ca`` everything is plain text.

    cert, key: own certificate and private key, PEM files (a server needs both for TLS; a client for mutual
        TLS).
    ca: certificate of the trusted authority, a PEM file. A client given one uses TLS; a server given one
        demands client certificates.
    tokens: token by caller name (see ``access``). A server accepts all of them; a client sends the first,
        whose name may be "".
    insecure: a server may listen beyond this machine without TLS or authentication; a client may send its
        token to another machine without TLS.
    """

    cert: Path | None = None
    key: Path | None = None
    ca: Path | None = None
    tokens: Mapping[str, str] = field(default_factory=dict)
    insecure: bool = False

    def metadata(self) -> tuple[tuple[str, str], ...]:
        """Per-call metadata of a client."""
        return tuple(("authorization", f"Bearer {token}") for token in list(self.tokens.values())[:1])

    @cached_property
    def access(self) -> Access:
        """Access rules of this server. Raises TransportError for options that do not suit a server."""
        if self.ca is not None and self.cert is None:
            raise TransportError("--tls-ca of a process that listens needs --tls-cert and --tls-key as well")
        try:
            return Access(self.tokens, certificates=self.ca is not None)
        except ValueError as error:
            raise TransportError(f"--token-file of a process that listens: a line is NAME TOKEN: {error}") from None

    def guard(self, host: str, what: str, http: bool = False) -> str:
        """Check that it is secure to listen on ``host``: loopback, or encrypted and authenticated.

        what: name of the service, for the message.
        http: callers can authenticate with tokens only, not with certificates.
        Returns "" if it is secure, else a warning if ``insecure`` is set. Raises TransportError if not.
        """
        missing = [] if self.cert else ["nothing is encrypted (--tls-cert, --tls-key)"]
        if self.access.open:
            missing.append(f"callers are not authenticated (--token-file{'' if http else ' or --tls-ca'})")
        elif http and not self.tokens:
            missing.append("nobody can log in (--token-file)")
        if is_loopback(host) or not missing:
            return ""
        words = f"{what} on {host} can be reached from other machines, and {' and '.join(missing)}"
        if not self.insecure:
            raise TransportError(
                f"cannot listen: {words}. Give these options (`edge-server keys` makes the files), listen on "
                "127.0.0.1, or say --insecure"
            )
        return words

    def tls(self, host: str) -> ssl.SSLContext | None:
        """TLS context of an HTTP server that listens on ``host``; None on loopback or without a certificate.
        Raises TransportError if the files cannot be used."""
        return None if self.cert is None or is_loopback(host) else self._context()

    def _context(self) -> ssl.SSLContext:
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            context.load_cert_chain(self.cert, self.key, password="")  # type: ignore[arg-type]
        except (OSError, ssl.SSLError) as error:
            raise TransportError(f"cannot use --tls-cert {self.cert} with its --tls-key: {error}") from None
        return context

    def aio_channel(self, target: str, options: list[tuple[str, Any]] = CLIENT_OPTIONS) -> grpc.aio.Channel:
        """Client channel to ``target`` (HOST:PORT); needs a running event loop. Raises TransportError if a
        token would be sent to another machine in plain text."""
        credentials = self._client_credentials(target)
        if credentials is None:
            return grpc.aio.insecure_channel(target, options=options)
        return grpc.aio.secure_channel(target, credentials, options=options)

    def channel(self, target: str) -> grpc.Channel:
        """Blocking client channel, for tools and tests. Raises as ``aio_channel``."""
        credentials = self._client_credentials(target)
        if credentials is None:
            return grpc.insecure_channel(target, options=CLIENT_OPTIONS)
        return grpc.secure_channel(target, credentials, options=CLIENT_OPTIONS)

    def aio_server(self, most_calls: int = MAX_CALLS) -> grpc.aio.Server:
        """Server without a port yet (see ``bind``); needs a running event loop. Raises TransportError as
        ``access``.

        most_calls: open at once, on one connection or on all.
        """
        streams = ("grpc.max_concurrent_streams", min(most_calls, MAX_CONCURRENT_STREAMS))
        return grpc.aio.server(options=[*SERVER_OPTIONS, streams], interceptors=[Admission(self.access, most_calls)])

    def bind(self, server: grpc.aio.Server, address: str) -> int:
        """Listen on ``host:port`` (port 0: any free one) and return the port.

        Raises TransportError if the address is invalid, the port is taken, the host is not this machine, or
        ``guard`` refuses.
        """
        try:
            host, number = host_port(address)
        except TransportError as error:
            raise TransportError(f"cannot listen on {address}: {error}") from None
        if words := self.guard(host, "gRPC"):
            log.warning("--insecure: %s", words)
        try:
            if self.cert is None:
                port = server.add_insecure_port(f"{host}:{number}")
            else:
                port = server.add_secure_port(f"{host}:{number}", self._server_credentials())
        except RuntimeError:  # its text is only useful for debugging gRPC
            port = 0
        if port == 0:
            raise TransportError(
                f"cannot listen on {address}: another process has the port, or {host} is not this machine's"
            )
        return port

    def _client_credentials(self, target: str) -> grpc.ChannelCredentials | None:
        if self.ca is not None:
            return grpc.ssl_channel_credentials(_pem(self.ca), _pem(self.key), _pem(self.cert))
        if self.tokens and not self.insecure and not is_loopback(target.rpartition(":")[0]):
            raise TransportError(f"the token would go to {target} in plain text: give --tls-ca, or say --insecure")
        return None

    def _server_credentials(self) -> grpc.ServerCredentials:
        if self.key is None:
            raise TransportError("--tls-cert needs --tls-key as well")
        self._context()  # gRPC does not say what is wrong with a file
        pair = (_pem(self.key), _pem(self.cert))
        return grpc.ssl_server_credentials([pair], _pem(self.ca), require_client_auth=self.ca is not None)


def add_arguments(parser: argparse.ArgumentParser, listens: bool = True) -> None:
    """Add the security options that all processes share. listens: whether this one is a server."""
    group = parser.add_argument_group("security", "off unless given; all processes take the same options")
    for option, metavar, text in (
        ("--tls-cert", "PEM", "certificate of this process"),
        ("--tls-key", "PEM", "private key of this process"),
        ("--tls-ca", "PEM", "trusted CA certificate: a client then uses TLS, a server demands client certificates"),
        (
            "--token-file",
            "FILE",
            "file of lines NAME TOKEN; NAME: operator, viewer, camera:ID[,ID] or camera:*. A client sends the first "
            "token (NAME may be left out), a server accepts all",
        ),
    ):
        group.add_argument(option, type=Path, metavar=metavar, help=text)
    group.add_argument(
        "--insecure",
        action="store_true",
        help="listen beyond this machine without TLS or without authentication"
        if listens
        else "send the token to another machine without TLS",
    )


def from_arguments(args: argparse.Namespace) -> Transport:
    """The Transport of the options of ``add_arguments``. Raises TransportError for unusable files."""
    for path in (args.tls_cert, args.tls_key, args.tls_ca):
        if path:
            _read(path)
    if (args.tls_cert is None) != (args.tls_key is None):
        raise TransportError("--tls-cert and --tls-key go together")
    tokens = _read_tokens(args.token_file) if args.token_file else {}
    transport = Transport(args.tls_cert, args.tls_key, args.tls_ca, tokens, args.insecure)
    # With a damaged file gRPC would retry for ever without a message.
    if args.tls_cert:
        transport._context()
    if args.tls_ca:
        try:
            ssl.create_default_context(cafile=args.tls_ca)
        except ssl.SSLError:
            raise TransportError(f"--tls-ca {args.tls_ca} holds no certificate (PEM)") from None
    return transport


def _read_tokens(path: Path) -> dict[str, str]:
    try:
        return parse_tokens(_read(path).decode(errors="replace"))
    except ValueError as error:
        raise TransportError(f"{path}: {error}") from None


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except OSError as error:
        raise TransportError(f"cannot read {path}: {error.strerror}") from None


def _pem(path: Path | None) -> bytes | None:
    return None if path is None else _read(path)
