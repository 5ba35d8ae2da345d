from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class GetStatusRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class CameraStatus(_message.Message):
    __slots__ = ("camera_id", "age_ms", "delivered", "rejected", "held_out")
    CAMERA_ID_FIELD_NUMBER: _ClassVar[int]
    AGE_MS_FIELD_NUMBER: _ClassVar[int]
    DELIVERED_FIELD_NUMBER: _ClassVar[int]
    REJECTED_FIELD_NUMBER: _ClassVar[int]
    HELD_OUT_FIELD_NUMBER: _ClassVar[int]
    camera_id: str
    age_ms: float
    delivered: int
    rejected: int
    held_out: bool
    def __init__(self, camera_id: _Optional[str] = ..., age_ms: _Optional[float] = ..., delivered: _Optional[int] = ..., rejected: _Optional[int] = ..., held_out: _Optional[bool] = ...) -> None: ...

class GetStatusResponse(_message.Message):
    __slots__ = ("scenario", "uptime_s", "cameras", "policy", "value", "paused", "last")
    SCENARIO_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    PAUSED_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    scenario: str
    uptime_s: float
    cameras: _containers.RepeatedCompositeFieldContainer[CameraStatus]
    policy: str
    value: float
    paused: bool
    last: Decision
    def __init__(self, scenario: _Optional[str] = ..., uptime_s: _Optional[float] = ..., cameras: _Optional[_Iterable[_Union[CameraStatus, _Mapping]]] = ..., policy: _Optional[str] = ..., value: _Optional[float] = ..., paused: _Optional[bool] = ..., last: _Optional[_Union[Decision, _Mapping]] = ...) -> None: ...

class WatchDecisionsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Decision(_message.Message):
    __slots__ = ("number", "decided_ns", "published_ns", "omega_ms", "selected", "aaoi_ms", "update_ms", "psnr_db", "psnr_moving_db", "ssim", "lpips")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    DECIDED_NS_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_NS_FIELD_NUMBER: _ClassVar[int]
    OMEGA_MS_FIELD_NUMBER: _ClassVar[int]
    SELECTED_FIELD_NUMBER: _ClassVar[int]
    AAOI_MS_FIELD_NUMBER: _ClassVar[int]
    UPDATE_MS_FIELD_NUMBER: _ClassVar[int]
    PSNR_DB_FIELD_NUMBER: _ClassVar[int]
    PSNR_MOVING_DB_FIELD_NUMBER: _ClassVar[int]
    SSIM_FIELD_NUMBER: _ClassVar[int]
    LPIPS_FIELD_NUMBER: _ClassVar[int]
    number: int
    decided_ns: int
    published_ns: int
    omega_ms: float
    selected: _containers.RepeatedScalarFieldContainer[str]
    aaoi_ms: float
    update_ms: float
    psnr_db: float
    psnr_moving_db: float
    ssim: float
    lpips: float
    def __init__(self, number: _Optional[int] = ..., decided_ns: _Optional[int] = ..., published_ns: _Optional[int] = ..., omega_ms: _Optional[float] = ..., selected: _Optional[_Iterable[str]] = ..., aaoi_ms: _Optional[float] = ..., update_ms: _Optional[float] = ..., psnr_db: _Optional[float] = ..., psnr_moving_db: _Optional[float] = ..., ssim: _Optional[float] = ..., lpips: _Optional[float] = ...) -> None: ...

class WatchDecisionsResponse(_message.Message):
    __slots__ = ("decision",)
    DECISION_FIELD_NUMBER: _ClassVar[int]
    decision: Decision
    def __init__(self, decision: _Optional[_Union[Decision, _Mapping]] = ...) -> None: ...

class ResetFieldRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ResetFieldResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class SaveSnapshotRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class SaveSnapshotResponse(_message.Message):
    __slots__ = ("path",)
    PATH_FIELD_NUMBER: _ClassVar[int]
    path: str
    def __init__(self, path: _Optional[str] = ...) -> None: ...

class SetPolicyRequest(_message.Message):
    __slots__ = ("name", "value", "paused")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    PAUSED_FIELD_NUMBER: _ClassVar[int]
    name: str
    value: float
    paused: bool
    def __init__(self, name: _Optional[str] = ..., value: _Optional[float] = ..., paused: _Optional[bool] = ...) -> None: ...

class SetPolicyResponse(_message.Message):
    __slots__ = ("name", "value", "paused")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    PAUSED_FIELD_NUMBER: _ClassVar[int]
    name: str
    value: float
    paused: bool
    def __init__(self, name: _Optional[str] = ..., value: _Optional[float] = ..., paused: _Optional[bool] = ...) -> None: ...
