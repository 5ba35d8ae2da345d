"""Bounds of what is accepted are part of the contract: a peer of another version, or another's, keeps within them, so a
changed one is a changed protocol. Written out, since the tests of each bound import it."""

from freshfield import limits

OF_A_FRAME = {
    "MAX_PAYLOAD_BYTES": 8_388_608,
    "MAX_MESSAGE_BYTES": 8_392_704,
    "MAX_IMAGE_SIDE_PX": 4096,
    "METERS_PER_COUNT": (1e-6, 1.0),
    "MAX_DEPTH_GAP_NS": 10_000_000_000,
    "MAX_ID_CHARS": 64,
    "MAX_CAPTURE_AHEAD_NS": 250_000_000,
    "MAX_CAPTURE_AGE_NS": 3_600_000_000_000,
    "MAX_CLOCK_UNCERTAINTY_NS": 1_000_000_000,
    "MAX_TRANSLATION_M": 1e6,
    "MAX_QUATERNION_ERROR": 1e-3,
    "MIN_FOCAL_PER_SIDE": 0.0625,
    "MAX_FOCAL_PX": 1e6,
    "MAX_DISTORTION": 100.0,
    "MAX_CENTER_OUTSIDE_SIDES": 1.0,
}
OF_CALLS = {
    "MAX_CAMERAS": 1000,
    "MAX_STREAMS_PER_CAMERA": 4,
    "MAX_SESSIONS_PER_CAMERA": 64,
    "SESSION_IDLE_NS": 2_000_000_000,
    "FIRST_MESSAGE_TIMEOUT_S": 10.0,
    "GRPC_IDLE_S": 60.0,
    "MAX_CALLS": 3000,
    "MAX_CONCURRENT_STREAMS": 1024,
}


def test_what_peers_may_send_is_what_was_agreed():
    for name, value in (OF_A_FRAME | OF_CALLS).items():
        assert getattr(limits, name) == value, name
