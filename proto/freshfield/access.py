"""Who may do what: one access model for gRPC, the page and the metrics.

A caller authenticates with a token or, over mutual TLS, with a certificate. Either identifies a caller name, which
determines the role::

    operator    viewer    camera:cam00    camera:cam00,cam01    camera:*

A server without tokens and without a certificate authority does not authenticate callers. It then listens on
loopback only (see ``Transport``), unless ``--insecure`` is given.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import ipaddress
import socket
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass

import grpc.aio

from freshfield.frame import valid_id

LOOK, CHANGE, PUSH, CLOCK = "look", "change", "push", "clock"
ROLES = {"camera": {PUSH, CLOCK}, "viewer": {LOOK, CLOCK}, "operator": {LOOK, CHANGE, CLOCK}}
CALLS = {
    "/freshfield.v1.FrameStreamService/Push": PUSH,
    "/freshfield.v1.ClockService/Exchange": CLOCK,
    "/freshfield.v1.EdgeService/GetStatus": LOOK,
    "/freshfield.v1.EdgeService/WatchDecisions": LOOK,
    "/freshfield.v1.EdgeService/ResetField": CHANGE,
    "/freshfield.v1.EdgeService/SaveSnapshot": CHANGE,
    "/freshfield.v1.EdgeService/SetPolicy": CHANGE,
    "/freshfield.v1.ChannelService/SetChannel": CHANGE,
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": LOOK,
}
"""The action that each gRPC method needs. Others (of a service behind ``channel-emu proxy``) need CHANGE."""


@dataclass(frozen=True)
class Caller:
    """A caller's rights.

    role: of ROLES, or "anybody" if callers are not authenticated.
    cameras: ids that the role camera may push; empty means all.
    """

    role: str
    cameras: frozenset[str] = frozenset()

    @classmethod
    def named(cls, name: str) -> Caller:
        """The caller with a name such as ``camera:cam00``. Raises ValueError for an invalid name."""
        role, _, listed = name.partition(":")
        cameras = frozenset() if listed == "*" else frozenset(listed.split(","))
        if role == "camera" and all(valid_id(camera) for camera in cameras):
            return cls(role, cameras)
        if role in ("viewer", "operator") and name == role:
            return cls(role)
        raise ValueError(f"expected operator, viewer, camera:ID[,ID] or camera:*, got {name[:80]!r}")

    def may(self, action: str) -> bool:
        """Whether the role allows the action: LOOK, CHANGE, PUSH or CLOCK."""
        return self.role == ANYBODY.role or action in ROLES[self.role]

    def may_push(self, camera: str) -> bool:
        return self.may(PUSH) and (not self.cameras or camera in self.cameras)


ANYBODY = Caller("anybody")
caller: ContextVar[Caller] = ContextVar("caller", default=ANYBODY)
"""Who makes the gRPC call that the current task serves."""


def parse_tokens(text: str) -> dict[str, str]:
    """Tokens by caller name, from lines NAME TOKEN; a single token alone gets the name "". Raises ValueError."""
    lines = [line.split() for line in text.splitlines() if line.strip()]
    tokens = {words[0] if len(words) == 2 else "": words[-1] for words in lines}
    if not lines:
        raise ValueError("the token file is empty")
    if (
        any(len(words) > 2 for words in lines)
        or len(tokens) < len(lines)
        or len(set(tokens.values())) < len(tokens)
        or ("" in tokens and len(lines) > 1)
    ):
        raise ValueError("expected lines NAME TOKEN, names and tokens all different, or one token alone")
    return tokens


class Access:
    """Authenticates callers.

    tokens: token by caller name.
    certificates: whether a client certificate's common name identifies the caller if no token is sent; a
        wrong token is refused even with a valid certificate.
    Raises ValueError for an invalid caller name.
    """

    def __init__(self, tokens: Mapping[str, str], certificates: bool) -> None:
        self._tokens = [(Caller.named(name), token.encode()) for name, token in tokens.items()]
        self._certificates = certificates

    @property
    def open(self) -> bool:
        """Whether callers are not authenticated at all."""
        return not self._tokens and not self._certificates

    @property
    def has_tokens(self) -> bool:
        return bool(self._tokens)

    def of_header(self, header: str) -> Caller | None:
        """The caller of an ``authorization`` header: Bearer TOKEN, or Basic with the token as password. None
        for an unknown token or another scheme."""
        kind, _, shown = header.partition(" ")
        token = shown.encode(errors="replace")
        if kind.lower() == "basic":
            try:
                token = base64.b64decode(token, validate=True).partition(b":")[2]
            except binascii.Error:
                return None
        elif kind.lower() != "bearer":
            return None
        # All tokens are compared, each in constant time, so that the time taken reveals nothing.
        found = [known for known, expected in self._tokens if hmac.compare_digest(token, expected)]
        return found[0] if found else None

    def of_certificate(self, context: grpc.aio.ServicerContext) -> Caller | None:
        """The caller of a client certificate; None without one, or if it names no caller."""
        names = context.auth_context().get("x509_common_name", []) if self._certificates else []
        try:
            return Caller.named(names[0].decode()) if names else None
        except ValueError:  # a certificate that was made for another purpose
            return None


class HttpRefused(Exception):
    """A refused HTTP request. status: HTTP status of the answer; the message is its body."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class HttpDoor:
    """Access checks of an HTTP server.

    access: who may log in. No login is asked for if it is open, or on loopback if it has no tokens.
    listening_on: address or name that the server listens on, as configured.
    """

    def __init__(self, access: Access, listening_on: str) -> None:
        asks = access.has_tokens or not (access.open or is_loopback(listening_on))
        self.access = access if asks else None
        self._names = {"localhost", listening_on.lower(), socket.gethostname().lower()}

    def check_origin(self, host: str | None, origin: str | None) -> None:
        """Refuse requests that another web site made a browser send.

        Raises HttpRefused if ``origin`` is not the page itself (cross-site request), or if ``host`` is not a
        name of this machine (DNS rebinding). Host is not checked if there is a login, because a browser does
        not send the login to another name; an IP address always passes, because it is the one connected to.
        """
        name = (host or "").lower()
        name = name[1:].partition("]")[0] if name.startswith("[") else name.partition(":")[0]
        if self.access is None and name not in self._names and not _is_address(name):
            raise HttpRefused(403, "Host is no name of this machine; --page-host takes another one")
        if origin is not None and origin.partition("://")[2].lower() != (host or "").lower():
            raise HttpRefused(403, "this request comes from another web site")

    def caller(self, authorization: str | None) -> Caller:
        """The caller of an ``authorization`` header. Raises HttpRefused unless it may LOOK."""
        if self.access is None:
            return ANYBODY
        found = self.access.of_header(authorization or "")
        if found is None or not found.may(LOOK):
            raise HttpRefused(401, "log in with the token of a viewer or an operator as password")
        return found


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens on ``host``."""
    name = host.strip("[]")
    return name == "localhost" or (_is_address(name) and ipaddress.ip_address(name).is_loopback)


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
