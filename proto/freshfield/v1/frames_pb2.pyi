from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Codec(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CODEC_UNSPECIFIED: _ClassVar[Codec]
    CODEC_JPEG: _ClassVar[Codec]
    CODEC_PNG: _ClassVar[Codec]
    CODEC_ZSTD: _ClassVar[Codec]

class Role(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ROLE_UNSPECIFIED: _ClassVar[Role]
    ROLE_TRAIN: _ClassVar[Role]
    ROLE_HELD_OUT: _ClassVar[Role]

class Outcome(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OUTCOME_UNSPECIFIED: _ClassVar[Outcome]
    OUTCOME_ACCEPTED: _ClassVar[Outcome]
    OUTCOME_DROPPED_BUSY: _ClassVar[Outcome]
    OUTCOME_SUPERSEDED: _ClassVar[Outcome]
    OUTCOME_REJECTED: _ClassVar[Outcome]

class DepthCodec(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_CODEC_UNSPECIFIED: _ClassVar[DepthCodec]
    DEPTH_CODEC_DELTA_ZSTD: _ClassVar[DepthCodec]
CODEC_UNSPECIFIED: Codec
CODEC_JPEG: Codec
CODEC_PNG: Codec
CODEC_ZSTD: Codec
ROLE_UNSPECIFIED: Role
ROLE_TRAIN: Role
ROLE_HELD_OUT: Role
OUTCOME_UNSPECIFIED: Outcome
OUTCOME_ACCEPTED: Outcome
OUTCOME_DROPPED_BUSY: Outcome
OUTCOME_SUPERSEDED: Outcome
OUTCOME_REJECTED: Outcome
DEPTH_CODEC_UNSPECIFIED: DepthCodec
DEPTH_CODEC_DELTA_ZSTD: DepthCodec

class Pose(_message.Message):
    __slots__ = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    QW_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    TX_M_FIELD_NUMBER: _ClassVar[int]
    TY_M_FIELD_NUMBER: _ClassVar[int]
    TZ_M_FIELD_NUMBER: _ClassVar[int]
    qw: float
    qx: float
    qy: float
    qz: float
    tx_m: float
    ty_m: float
    tz_m: float
    def __init__(self, qw: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ..., tx_m: _Optional[float] = ..., ty_m: _Optional[float] = ..., tz_m: _Optional[float] = ...) -> None: ...

class Intrinsics(_message.Message):
    __slots__ = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    K1_FIELD_NUMBER: _ClassVar[int]
    K2_FIELD_NUMBER: _ClassVar[int]
    P1_FIELD_NUMBER: _ClassVar[int]
    P2_FIELD_NUMBER: _ClassVar[int]
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    def __init__(self, fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., k1: _Optional[float] = ..., k2: _Optional[float] = ..., p1: _Optional[float] = ..., p2: _Optional[float] = ...) -> None: ...

class FrameHeader(_message.Message):
    __slots__ = ("camera_id", "session_id", "sequence", "generated_ns", "clock_offset_ns", "clock_uncertainty_ns", "pose", "pose_gap_ns", "intrinsics", "codec", "width", "height", "role")
    CAMERA_ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    GENERATED_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_UNCERTAINTY_NS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    POSE_GAP_NS_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    CODEC_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    ROLE_FIELD_NUMBER: _ClassVar[int]
    camera_id: str
    session_id: str
    sequence: int
    generated_ns: int
    clock_offset_ns: int
    clock_uncertainty_ns: int
    pose: Pose
    pose_gap_ns: int
    intrinsics: Intrinsics
    codec: Codec
    width: int
    height: int
    role: Role
    def __init__(self, camera_id: _Optional[str] = ..., session_id: _Optional[str] = ..., sequence: _Optional[int] = ..., generated_ns: _Optional[int] = ..., clock_offset_ns: _Optional[int] = ..., clock_uncertainty_ns: _Optional[int] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., pose_gap_ns: _Optional[int] = ..., intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., codec: _Optional[_Union[Codec, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., role: _Optional[_Union[Role, str]] = ...) -> None: ...

class Depth(_message.Message):
    __slots__ = ("codec", "width", "height", "meters_per_count", "after_image_ns", "intrinsics", "to_camera", "payload")
    CODEC_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    METERS_PER_COUNT_FIELD_NUMBER: _ClassVar[int]
    AFTER_IMAGE_NS_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    TO_CAMERA_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    codec: DepthCodec
    width: int
    height: int
    meters_per_count: float
    after_image_ns: int
    intrinsics: Intrinsics
    to_camera: Pose
    payload: bytes
    def __init__(self, codec: _Optional[_Union[DepthCodec, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., meters_per_count: _Optional[float] = ..., after_image_ns: _Optional[int] = ..., intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., to_camera: _Optional[_Union[Pose, _Mapping]] = ..., payload: _Optional[bytes] = ...) -> None: ...

class PushRequest(_message.Message):
    __slots__ = ("header", "payload", "crc32c", "depth")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    CRC32C_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    header: FrameHeader
    payload: bytes
    crc32c: int
    depth: Depth
    def __init__(self, header: _Optional[_Union[FrameHeader, _Mapping]] = ..., payload: _Optional[bytes] = ..., crc32c: _Optional[int] = ..., depth: _Optional[_Union[Depth, _Mapping]] = ...) -> None: ...

class PushResponse(_message.Message):
    __slots__ = ("sequence", "outcome", "reason", "detail")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    outcome: Outcome
    reason: str
    detail: str
    def __init__(self, sequence: _Optional[int] = ..., outcome: _Optional[_Union[Outcome, str]] = ..., reason: _Optional[str] = ..., detail: _Optional[str] = ...) -> None: ...
