from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class ExchangeRequest(_message.Message):
    __slots__ = ("client_sent_ns",)
    CLIENT_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    client_sent_ns: int
    def __init__(self, client_sent_ns: _Optional[int] = ...) -> None: ...

class ExchangeResponse(_message.Message):
    __slots__ = ("client_sent_ns", "server_received_ns", "server_sent_ns")
    CLIENT_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    SERVER_RECEIVED_NS_FIELD_NUMBER: _ClassVar[int]
    SERVER_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    client_sent_ns: int
    server_received_ns: int
    server_sent_ns: int
    def __init__(self, client_sent_ns: _Optional[int] = ..., server_received_ns: _Optional[int] = ..., server_sent_ns: _Optional[int] = ...) -> None: ...
