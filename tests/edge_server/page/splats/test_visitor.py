"""What a visitor is sent over links of other speeds, in virtual time."""

import math
from collections import deque
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from channel_emu.live.live_emulator_constants import PIECE_BYTES, RESEND_AFTER_S
from edge_server.page.splats import messages
from edge_server.page.splats import splat_stream_constants as tuned
from edge_server.page.splats.published import Published, Publisher
from edge_server.page.splats.records import from_records
from edge_server.page.splats.visitor import LinkWindow, Visitor
from tests.edge_server.page.splats.gaussians import NEWEST_S, gaussians, motion, snapshot

COUNT = 6000


class Line:
    """One direction of a link: bytes a second, then a delay, first come first served."""

    def __init__(self, rate: float, delay_s: float = 0.02) -> None:
        self.rate, self.delay_s, self.free_s = rate, delay_s, 0.0

    def carry(self, size: int, now_s: float) -> float:
        """When so many bytes arrive."""
        self.free_s = max(self.free_s, now_s) + size / self.rate
        return self.free_s + self.delay_s


class Scattering:
    """One direction of TCP over a link of the emulator: pieces of 16 kB wait for one another, each takes an exponential
    time, and what is lost goes again after a timeout, while all that follows waits."""

    delay_s = 0.0

    def __init__(self, mean_s: float, loss: float, rng: np.random.Generator) -> None:
        self.mean_s, self.loss, self.rng = mean_s, loss, rng
        self.free_s = self.last_s = 0.0

    def carry(self, size: int, now_s: float) -> float:
        for _ in range(-(-size // PIECE_BYTES)):
            times = self.rng.geometric(1.0 - self.loss)
            self.free_s = max(self.free_s, now_s) + self.rng.exponential(self.mean_s, times).sum()
            self.last_s = max(self.last_s, self.free_s + RESEND_AFTER_S * (times - 1))
        return self.last_s


class Link:
    """A visitor at the end of a link. ages_s: of the publication that is shown, at each tick."""

    def __init__(
        self, there: Line | Scattering, back: Line | Scattering | None = None, publisher: SimpleNamespace | None = None
    ) -> None:
        self.there, self.back = there, back or Line(math.inf)
        self.visitor, self.reader, self.publisher = Visitor(), messages.StreamReader(), publisher or Publisher(0)
        self.under_way: deque[tuple[float, bytes]] = deque()
        self.acknowledged: deque[tuple[float, int]] = deque()
        self.lags_s: list[float] = []
        self.ages_s: list[float] = []
        self.blocks: list[tuple[float, object]] = []

    def run(self, seconds: range, shown=None) -> None:
        """Ticks of 30 ms; the field trains a little at each. shown: of an instant, what is published."""
        for tick in seconds:
            now_s = tick * tuned.TICK_S
            while self.under_way and self.under_way[0][0] <= now_s:
                came_s, data = self.under_way.popleft()
                self.reader.read(data)
                number, _, blocks = messages.read_message(data)
                self.blocks += [(now_s, block) for block in blocks]
                self.acknowledged.append((self.back.carry(4, came_s), number))
            while self.acknowledged and self.acknowledged[0][0] <= now_s:
                self.visitor.acknowledged(self.acknowledged.popleft()[1], now_s)
            published = self.publisher.take((shown or trained)(now_s), now_s)
            data = self.visitor.message(published, NEWEST_S, {"line": ""}, now_s)
            if data is not None:
                self.under_way.append((self.there.carry(len(data), now_s), data))
                self.lags_s.append(self.under_way[-1][0] - self.there.delay_s - now_s)
            if published.knots is not None and self.reader._knots is not None:
                self.ages_s.append(published.knots.newest_s - self.reader._knots.newest_s)

    def of(self, kind: type, since_s: float = 0.0) -> list:
        return [block for at_s, block in self.blocks if isinstance(block, kind) and at_s >= since_s]

    def record_bytes(self, since_s: float = 0.0) -> int:
        sizes = {messages.StaticBlock: 16, messages.MovingBlock: 21}
        return sum(size * len(block.records) for kind, size in sizes.items() for block in self.of(kind, since_s))


def trained(now_s: float):
    """The same Gaussians, a little other each half second; frames come on."""
    params = gaussians(COUNT, 0) + np.float32(0.02 * int(now_s / 0.5) / 100)
    return snapshot(params, movers=1000, newest_s=NEWEST_S + now_s)


@cache
def _tenth(number: int):
    return trained(0.1 * number)


def tenths(now_s: float):
    """As ``trained``, with ten publications a second."""
    return _tenth(int(now_s / 0.1))


@pytest.fixture(scope="module")
def publisher() -> SimpleNamespace:
    """Of ``tenths``, for links that look at the same instants: what it publishes is made once."""
    publisher, made = Publisher(0), {}

    def take(shown, now_s: float) -> Published | None:
        if now_s not in made:
            made[now_s] = publisher.take(shown, now_s)
        return made[now_s]

    return SimpleNamespace(take=take)


def ticks(seconds: float, since_s: float = 0.0) -> range:
    return range(round(since_s / tuned.TICK_S), round(seconds / tuned.TICK_S))


def test_a_fast_link_has_everything_and_goes_on():
    link = Link(Line(2e6))
    link.run(ticks(3.0))
    assert len(link.reader.at(NEWEST_S)) == COUNT + 1000
    assert 15 <= len(link.of(messages.MovingBlock, since_s=1.0)) <= 20  # ten a second
    assert len(link.of(messages.KnotsBlock, since_s=1.0)) > 50  # with each publication
    assert max(link.lags_s) < 0.12
    assert link.reader.status["link"]["static"] == [COUNT, COUNT]
    link.run(ticks(4.0, 3.0), lambda now_s: replace(trained(1.0), moving=None))
    assert len(link.reader.at(NEWEST_S)) == COUNT  # what moved has left, and this is said once
    assert [len(block.records) for block in link.of(messages.MovingBlock, since_s=3.0)].count(0) == 1


@pytest.mark.parametrize("kilobytes, all_of_it, lag_s", [(15, False, 0.65), (60, True, 0.35)])
def test_a_slow_link_is_kept_short_and_shows_what_is_large(kilobytes, all_of_it, lag_s):
    link = Link(Line(1e3 * kilobytes))
    link.run(ticks(12.0))
    assert np.quantile(link.lags_s[len(link.lags_s) // 3 :], 0.9) < lag_s  # of a queue that would hold seconds
    static, drawn = link.publisher._newest.static, link.reader._shown.params
    here = len(drawn)
    assert (here == COUNT) == all_of_it and here > 0.15 * COUNT
    places = from_records(static.records[:here], static.scales)[:, :3]
    np.testing.assert_allclose(drawn[:, :3], places, atol=0.006)  # the largest ones, some of them not the newest
    sizes = {len(block.records) for block in link.of(messages.MovingBlock, since_s=4.0)}
    assert sizes and max(sizes) < 1000
    assert len(link.of(messages.KnotsBlock, since_s=4.0)) > 2 * len(link.of(messages.MovingBlock, since_s=4.0)) > 3
    assert link.record_bytes() > 0.5 * 12.0 * link.there.rate  # and it is used
    link.there.rate = 2e6  # a link that becomes faster gets the rest
    link.run(ticks(16.0, 12.0))
    assert len(link.visitor._sent) == COUNT and len(link.reader.at(NEWEST_S)) == COUNT + 1000


def test_an_outage_makes_no_link_one_whose_delays_scatter(publisher):
    link, stall_s = Link(Line(60e3), publisher=publisher), 10.0
    link.run(ticks(12.0), tenths)
    link.under_way[-1] = (link.under_way[-1][0] + stall_s, link.under_way[-1][1])
    link.there.free_s += stall_s
    link.run(ticks(22.0, 12.0), tenths)
    sent = len(link.lags_s)
    link.run(ticks(60.0, 22.0), tenths)
    assert np.quantile(link.lags_s[sent:], 0.9) < 0.35, "as without one"


def test_a_link_whose_delays_scatter_gets_half_of_what_it_takes_and_has_no_long_queue(publisher):
    """Mean delay 400 ms, a fifth lost: the live page's bad network, three of which are carried half full on average."""
    mean_s, loss, sent = 0.4, 0.2, 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        link = Link(Scattering(mean_s, loss, rng), Scattering(mean_s, loss, rng), publisher)
        link.run(ticks(60.0), tenths)
        sent += link.record_bytes(since_s=15.0)
        ages_s = link.ages_s[len(link.ages_s) // 4 :]
        assert np.median(ages_s) < 3.0 and np.quantile(ages_s, 0.9) < 6.0 and max(link.ages_s) < 10.0
        assert len(link.reader._shown.params) == COUNT  # all that stands still, after a minute
    assert sent / (3 * 45.0) > 0.5 * PIECE_BYTES * (1.0 - loss) / mean_s


def test_who_reads_nothing_costs_a_window():
    visitor, published, sent = Visitor(), Publisher(0).take(trained(0.0), 0.0), 0
    for tick in ticks(30.0):
        data = visitor.message(published, NEWEST_S, {}, tick * tuned.TICK_S)
        sent += 0 if data is None else len(data)
    assert tuned.FIRST_WINDOW / 2 < sent <= 1.1 * tuned.FIRST_WINDOW


def test_a_growing_field_replaces_sets_that_are_whole():
    link, counts = Link(Line(300e3)), []

    def growing(now_s):
        return snapshot(gaussians(COUNT, 0)[: 2000 + 80 * int(now_s / 0.09)], movers=0)

    for second in range(8):
        link.run(ticks(second + 1.0, float(second)), growing)
        counts.append(len(link.reader.at(-1e9)))
    assert counts == sorted(counts) and counts[-1] > 4500 and len(set(counts)) >= 5
    assert {block.total for block in link.of(messages.StaticBlock)} >= set(counts)


@pytest.mark.stability
def test_numbers_that_were_not_sent_change_nothing():
    link = LinkWindow()
    link.sent(3, 1000, 0.0)
    for number in (0, 2, 4, 2**32 - 1):
        link.acknowledged(number, 1.0)
    assert link.under_way == 1000
    link.acknowledged(3, 0.05)
    link.acknowledged(3, 0.06)
    assert link.under_way == 0 and link.round_trip_s == pytest.approx(0.05)


@pytest.mark.stability
def test_before_there_is_a_field_the_status_says_so():
    visitor = Visitor()
    data = visitor.message(None, 0.3, {"line": "compiling"}, 0.0)
    assert messages.read_message(data)[2][0].content["line"] == "compiling"
    assert [visitor.message(None, 0.3, {}, now_s) is not None for now_s in (0.1, 0.5)] == [False, True]
    assert not visitor.link.short, "there was no more to send"


@pytest.mark.parametrize("kilobytes", [20, 2000])
def test_what_moves_stays_when_anchors_are_chosen_anew(kilobytes):
    link, anchors = Link(Line(1e3 * kilobytes)), [motion().anchors.copy() for _ in range(2)]

    def anew(now_s):
        """Other anchors each half second."""
        shown = trained(now_s)
        again = shown.moving.motion.copy()
        again.anchors = anchors[int(now_s / 0.5) % 2]
        return replace(shown, moving=replace(shown.moving, motion=again))

    link.run(ticks(2.0), anew)
    for tick in ticks(6.0, 2.0):
        link.run(range(tick, tick + 1), anew)
        assert len(link.reader.at(NEWEST_S)) > len(link.reader._shown.params)
    assert len({block.anchors for block in link.of(messages.MovingBlock)}) > 6


def test_what_no_camera_has_seen_is_said_also_when_it_is_known_later():
    visitor, published, said = Visitor(), Publisher(0).take(trained(0.0), 0.0), []
    unseen = np.arange(COUNT) % 3 == 0
    for tick in ticks(2.0):
        now_s = tick * tuned.TICK_S
        if now_s > 1.0 and published.static.unseen is None:
            published = replace(published, static=replace(published.static, unseen=unseen))
        data = visitor.message(published, NEWEST_S, {}, now_s)
        if data is not None:
            number, _, blocks = messages.read_message(data)
            visitor.acknowledged(number, now_s + 0.01)
            said += [(now_s, block.bits) for block in blocks if isinstance(block, messages.UnseenBlock)]
    ((when_s, bits),) = said
    assert 1.0 < when_s < 1.1
    np.testing.assert_array_equal(bits, unseen)
