from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class SetChannelRequest(_message.Message):
    __slots__ = ("delay_ms", "loss")
    DELAY_MS_FIELD_NUMBER: _ClassVar[int]
    LOSS_FIELD_NUMBER: _ClassVar[int]
    delay_ms: float
    loss: float
    def __init__(self, delay_ms: _Optional[float] = ..., loss: _Optional[float] = ...) -> None: ...

class SetChannelResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
