"""The ``channel`` fixture as a user has it: a link between the server and the clients of their service."""

import itertools
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent import futures

import grpc
import pytest

from channel_emu.live import call_flow, proxy
from channel_emu.live import live_emulator_constants as tuned
from channel_emu.testing import EmulatedLink, channel
from tests.support import refused, wait_until

assert channel  # the fixture; where a conftest.py lists the plugin, no import is needed
pytest_plugins = ["pytester"]

HELLO, COUNT, COLLECT, ECHO = (f"/greet.Greeter/{name}" for name in ("Hello", "Count", "Collect", "Echo"))
LOSSY = {"faults": {"loss": {"probability": 0.5}}}


class Greeter:
    """A service with all four kinds of call, without protobuf: bytes in, bytes out."""

    def __init__(self) -> None:
        self.collected: list[bytes] = []
        self.cancelled = threading.Event()
        self.deadline_s = 0.0
        self._server = grpc.server(futures.ThreadPoolExecutor(8))
        handlers = {
            "Hello": grpc.unary_unary_rpc_method_handler(self.hello),
            "Count": grpc.unary_stream_rpc_method_handler(self.count),
            "Collect": grpc.stream_unary_rpc_method_handler(self.collect),
            "Echo": grpc.stream_stream_rpc_method_handler(lambda requests, _: requests),
        }
        self._server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("greet.Greeter", handlers),))
        self.address = f"127.0.0.1:{self._server.add_insecure_port('127.0.0.1:0')}"
        self._server.start()

    def hello(self, request: bytes, context: grpc.ServicerContext) -> bytes:
        self.deadline_s = context.time_remaining() or 0.0
        if not request:
            context.set_trailing_metadata((("why", "because"),))
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, "not today")
        context.send_initial_metadata((("greeting", "first"),))
        name = dict(context.invocation_metadata()).get("name", "nobody")
        context.set_trailing_metadata((("served", "yes"), ("raw-bin", b"\x00\xff")))
        return b"hello " + request + b" from " + str(name).encode()

    def count(self, request: bytes, context: grpc.ServicerContext) -> Iterator[bytes]:
        context.add_callback(self.cancelled.set)
        for n in range(int(request)):
            yield str(n).encode()
            time.sleep(0.01)

    def collect(self, requests: Iterator[bytes], context: grpc.ServicerContext) -> bytes:
        self.collected = list(requests)
        return str(len(self.collected)).encode()

    def stop(self) -> None:
        self._server.stop(None)


@pytest.fixture
def greeter() -> Iterator[Greeter]:
    served = Greeter()
    yield served
    served.stop()


def client(link: EmulatedLink) -> grpc.Channel:
    """A plain client channel to the link."""
    return grpc.insecure_channel(link.address)


def paced(count: int, every_s: float) -> Iterator[bytes]:
    begun = time.monotonic()
    for n in range(count):
        time.sleep(max(0.0, begun + n * every_s - time.monotonic()))
        yield str(n).encode()


def code_of(call, *words, **options) -> str:
    """How a unary call ends."""
    try:
        call(*words, **{"timeout": 10, **options})
        return "OK"
    except grpc.RpcError as error:
        return error.code().name


def test_a_streams_ages_and_losses_are_the_channels(channel, greeter):
    """The example: 100 messages, one each 10 ms, over a link that takes 15 ms and drops what finds it busy:
    every second one gets through, if the machine paces them evenly."""
    link = channel({"service": "det:15ms", "discipline": "drop-new"}, to=greeter.address, seed=1)
    answer = client(link).stream_unary(COLLECT)(paced(100, 0.010))
    report = link.settle()
    assert report.offered == 100 and int(answer) == len(greeter.collected) == report.delivered < 100
    assert report.dropped == report.outcomes["dropped_busy"] == 100 - report.delivered
    assert 20 < report.mean_age_ms < report.peak_age_ms
    # It also hands messages on late, by an error that it reports.
    assert report.delay_ms["mean"] == 15.0 <= report.latency_ms["mean"] <= 15 + report.error_ms["max"]
    # What came is in order, and is what was sent.
    numbers = [int(word) for word in greeter.collected]
    assert numbers == sorted(set(numbers)) and report.by_method[f"up {COLLECT}"].offered == 100


def test_a_dropped_unary_call_is_unavailable_and_the_same_ones_are_dropped_again(channel, greeter):
    """Draws are looked up by the message's number: whatever the timing."""

    def codes(seed: int) -> list[str]:
        link = channel(LOSSY, to=greeter.address, seed=seed)
        found = [code_of(client(link).unary_unary(HELLO), b"you") for _ in range(40)]
        assert found.count("UNAVAILABLE") == link.settle().outcomes["lost"]
        return found

    first = codes(3)
    assert set(first) == {"OK", "UNAVAILABLE"} and 8 < first.count("OK") < 32
    assert codes(3) == first != codes(4)


def test_dropped_stream_messages_are_left_out_in_both_directions(channel, greeter):
    link = channel(LOSSY, to=greeter.address, seed=5, direction="both")
    answers = list(client(link).stream_stream(ECHO)(paced(60, 0.001), timeout=20))
    report = link.settle()
    up, down = report.by_method[f"up {ECHO}"], report.by_method[f"down {ECHO}"]
    assert up.offered == 60 and down.offered == up.delivered and len(answers) == down.delivered
    assert 15 < up.delivered < 45 and 4 < down.delivered < up.delivered
    numbers = [int(answer) for answer in answers]
    assert numbers == sorted(set(numbers)) and set(numbers) <= set(range(60))


def test_metadata_status_trailers_and_deadline_pass(channel, greeter):
    stub = client(channel({"service": "det:40ms"}, to=greeter.address, direction="both"))
    begun = time.monotonic()
    answer, call = stub.unary_unary(HELLO).with_call(b"you", timeout=5, metadata=(("name", "a test"),))
    took_ms = (time.monotonic() - begun) * 1e3
    assert answer == b"hello you from a test" and 80 <= took_ms < 1000
    assert ("greeting", "first") in call.initial_metadata()
    trailers = dict(call.trailing_metadata())
    assert trailers["served"] == "yes" and trailers["raw-bin"] == b"\x00\xff"
    # The service knows how long its client still waits (gRPC rounds it to some hundredths).
    assert 4.0 < greeter.deadline_s < 5.0
    with pytest.raises(grpc.RpcError) as failed:
        stub.unary_unary(HELLO)(b"", timeout=5)
    assert failed.value.code() is grpc.StatusCode.FAILED_PRECONDITION and failed.value.details() == "not today"
    assert dict(failed.value.trailing_metadata())["why"] == "because"
    assert code_of(stub.unary_unary("/greet.Greeter/Missing"), b"") == "UNIMPLEMENTED"
    assert code_of(stub.unary_unary(HELLO), b"you", timeout=0.02) == "DEADLINE_EXCEEDED"


def test_a_reset_ends_a_call_whose_request_has_passed(greeter, channel):
    link = channel({"faults": {"reset": {"at_ms": [500.0]}}}, to=greeter.address)
    assert code_of(lambda **o: list(client(link).unary_stream(COUNT)(b"300", **o))) == "UNAVAILABLE"


def test_calls_that_a_reset_ends_in_the_midst_of_an_answer_are_told_so(greeter, channel):
    """One of a hundred waited without end: a call cannot send two things at once."""
    link = channel({"faults": {"reset": {"at_ms": [10.0 * k for k in range(1, 900)]}}}, to=greeter.address)
    echo = client(link).stream_stream(ECHO)
    codes = Counter(code_of(lambda **o: deque(echo(itertools.repeat(bytes(3000)), **o), 0)) for _ in range(300))
    assert set(codes) == {"UNAVAILABLE"}, codes


def test_cancellation_reaches_the_service_and_frees_the_link(channel, greeter):
    link = channel({"service": "det:5ms", "discipline": "fcfs"}, to=greeter.address, direction="down")
    call = client(link).unary_stream(COUNT)(b"1000", timeout=30)
    assert [int(word) for word in itertools.islice(call, 3)] == [0, 1, 2]
    call.cancel()
    assert greeter.cancelled.wait(5)
    report = link.settle()
    assert report.offered < 100 and report.in_flight == 0
    assert report.delivered == report.outcomes["forwarded"] + report.outcomes.get("cancelled", 0)


def test_calls_that_are_open_at_the_end_are_told_so_and_nothing_is_printed(channel, greeter, caplog):
    link = channel("ideal", to=greeter.address)
    call = client(link).unary_stream(COUNT)(b"1000", timeout=30)
    next(call)
    link.close()
    assert code_of(lambda **_: list(call)) == "UNAVAILABLE" and call.details() == "the channel emulator ends"
    assert caplog.text == ""


def test_behind_a_message_in_the_link_no_more_are_read_than_the_bound(channel, greeter, monkeypatch):
    monkeypatch.setattr(call_flow.CallFlow, "most_behind", 10)
    link = channel({"service": "det:300ms", "discipline": "fcfs", "queue_limit": 1000}, to=greeter.address)
    answers = client(link).stream_stream(ECHO)(paced(100, 0.0), timeout=20)
    wait_until(lambda: link.report().offered == 10, "messages do not come")
    time.sleep(0.1)
    assert link.report().offered == 10
    assert next(answers) == b"0"
    wait_until(lambda: link.report().offered == 11, "it does not go on")


def test_messages_that_nobody_reads_are_counted_and_a_wrong_address_is_refused(channel, monkeypatch):
    refused(ValueError, "to: expected HOST:PORT", channel, "ideal", to="greeter")
    monkeypatch.setattr(proxy.Proxy, "pending", 3)
    refused(TimeoutError, "^3 messages .* wait for their reader, after", channel("ideal", to="127.0.0.1:1").settle, 0.1)


def test_no_service_and_a_link_that_failed_say_so_and_it_still_closes(channel):
    link = channel("ideal", to="127.0.0.1:1")
    assert code_of(client(link).unary_unary(HELLO), b"") == "UNAVAILABLE"
    link._loop.call_soon_threadsafe(link._proxy.fail, OSError(28, "No space left on device"))
    refused(proxy.EmulatorFailed, "room on the disk", link.settle)
    link.close()


def test_damage_and_doubles(channel, greeter):
    stub = client(channel({"faults": {"duplication": 1.0}}, to=greeter.address))
    doubled = list(stub.stream_stream(ECHO)(iter([b"a", b"b", b"c"]), timeout=5))
    assert doubled[1:] == [b"b", b"b", b"c", b"c"] or doubled == [b"a", b"a", b"b", b"b", b"c", b"c"]
    assert stub.unary_unary(HELLO)(b"you", timeout=5).startswith(b"hello you")
    damaging = client(channel({"faults": {"corruption": 1.0}}, to=greeter.address))
    (answer,) = damaging.stream_stream(ECHO)(iter([b"payload"]), timeout=5)
    assert len(answer) == 7 and sum(a != b for a, b in zip(answer, b"payload")) == 1


def test_methods_that_a_client_invents_share_one_link(channel, greeter, monkeypatch):
    monkeypatch.setattr(tuned, "MOST_METHODS", 2)
    link = channel("ideal", to=greeter.address)
    for n in range(5):
        code_of(client(link).unary_unary(f"/a.B/C{n}"), b"")  # the service has none of them
    by_method = link.settle().by_method
    assert set(by_method) == {"up /a.B/C0", "up /a.B/C1", "up (other methods)"}
    assert by_method["up (other methods)"].offered == 3


def test_a_failing_test_shows_the_seed_and_the_figures(pytester):
    pytester.makeconftest('pytest_plugins = ["channel_emu.testing"]')
    pytester.makepyfile(
        """
        def test_fails(channel):
            assert channel("ch5", to="127.0.0.1:1", seed=77).report().offered == 1
        """
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*emulated channel*", "channel('ch5', to='127.0.0.1:1', seed=77, *"])
