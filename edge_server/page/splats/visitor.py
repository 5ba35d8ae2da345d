"""Decides what to send to one visitor, and when: never more than their link can carry.

The window of bytes in flight follows delay, as in LEDBAT (RFC 6817): a link is full if its round trips grow with the
bytes in flight. A link whose delays scatter by themselves gets few large messages. What does not fit is left out in
this order: small Gaussians, static sets that changed little, moving sets, and last knots, which move Gaussians that
the visitor already has.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.page.splats import splat_stream_constants as tuned
from edge_server.page.splats.messages import (
    MovingBlock,
    StaticBlock,
    StatusBlock,
    UnseenBlock,
    write_block,
    write_message,
)
from edge_server.page.splats.published import Published, StaticRecords
from edge_server.page.splats.records import RECORD, noticeable

_MOVING_BYTES = RECORD.itemsize + 5
_HEADS = 32  # bytes of a static block beside its records
EMPTY = MovingBlock(0, (-1.0, 0.0), np.zeros(0, RECORD), np.zeros((0, 3), np.uint8), np.zeros((0, 2), np.uint8))


class LinkWindow:
    """The window of bytes in flight, from the delays of acknowledged messages.

    Round trips are fitted, by least squares, by a base time per message and a time per byte in flight: the base may
    scatter, what bytes add is a queue. The newest count most.

    short: whether there was more to send than the window allowed.
    """

    def __init__(self) -> None:
        self.short = False
        self.window = float(tuned.FIRST_WINDOW)
        self.under_way = 0
        self.rate_bytes_per_s = 0.0
        self._sent: deque[tuple[int, int, float, int]] = deque()  # number, bytes, when, bytes in flight then
        self._round_trips: deque[tuple[float, float]] = deque()  # when, seconds
        self._moments = np.zeros(5)  # weighted sums of 1, bytes, seconds, bytes^2, bytes * seconds
        self.round_trip_s = 0.0  # the shortest recent one
        self.alone_s, self._per_byte_s = 0.0, 1e-12  # fitted base time of a message, and time per byte in flight
        self._since_s, self._acknowledged = 0.0, 0

    @property
    def scatters(self) -> bool:
        """Whether round trips scatter without a queue."""
        return self.alone_s - self.round_trip_s > tuned.QUEUE_S

    @property
    def room(self) -> int:
        """Bytes that may be sent now; on a link that scatters, in a few large messages."""
        if self.scatters and len(self._sent) >= tuned.SCATTERING_UNDER_WAY:
            return 0
        return min(max(int(self.window) - self.under_way, 0), self.share if self.scatters else tuned.MOST_WINDOW)

    @property
    def share(self) -> int:
        """Bytes of a message with static Gaussians: the fit needs a varying number of bytes in flight."""
        share = int(self.window) // (tuned.SCATTERING_UNDER_WAY if self.scatters else tuned.UNDER_WAY)
        return max(min(share, tuned.MOST_MESSAGE), tuned.LEAST_MESSAGE)

    def sent(self, number: int, size: int, now_s: float) -> None:
        """Record a sent message of ``size`` bytes."""
        if not self._sent and not self._acknowledged:
            self._since_s = now_s
        self.under_way += size
        self._sent.append((number, size, now_s, self.under_way))

    def acknowledged(self, number: int, now_s: float) -> None:
        """Record that the visitor has read all messages up to this one. Unknown numbers are ignored."""
        if not any(sent == number for sent, *_ in self._sent):
            return
        size, sent = 0, -1
        while sent != number:
            sent, bytes_, sent_s, under_way = self._sent.popleft()
            size += bytes_
        self.under_way -= size
        self._count(size, now_s)
        while self._round_trips and self._round_trips[0][0] < now_s - tuned.FORGET_RTT_S:
            self._round_trips.popleft()
        self._round_trips.append((now_s, now_s - sent_s))
        self.round_trip_s = min(trip for _, trip in self._round_trips)
        self._fit_window(size, under_way, now_s - sent_s)

    def _fit_window(self, size: int, under_way: int, round_trip_s: float) -> None:
        """Fit the window to the newest round trip, that of a message with ``under_way`` bytes in flight, whose
        acknowledgement covered ``size`` bytes."""
        if self._moments[0]:  # an outage is none of the link's usual delays
            round_trip_s = min(round_trip_s, tuned.OUTAGE * max(self._moments[2] / self._moments[0], tuned.QUEUE_S))
        newest = np.array([1.0, under_way, round_trip_s, under_way**2, under_way * round_trip_s])
        self._moments = tuned.KEPT_OF_ROUND_TRIPS * self._moments + newest
        _, mean, mean_s, square, product = self._moments / self._moments[0]
        spread = square - mean**2
        if spread > (tuned.LEAST_SPREAD * mean) ** 2:
            per_byte_s = (product - mean * mean_s) / spread
        else:  # all alike: nothing tells the two apart
            per_byte_s = mean_s / mean
        self._per_byte_s = max(float(per_byte_s), 1e-12)
        self.alone_s = max(float(mean_s - self._per_byte_s * mean), self.round_trip_s)
        full = (self.alone_s + tuned.QUEUE_S) / self._per_byte_s
        if full < self.window:
            self.window = max(full, tuned.BACK_OFF * self.window, tuned.LEAST_WINDOW)
        elif self.short:  # a window that suffices says nothing of the link
            self.window = min(self.window + size, full, tuned.MOST_WINDOW)

    def _count(self, size: int, now_s: float) -> None:
        self._acknowledged += size
        if now_s - self._since_s >= tuned.STATUS_EVERY_S:
            self.rate_bytes_per_s = self._acknowledged / (now_s - self._since_s)
            self._since_s, self._acknowledged = now_s, 0

    @property
    def bound_bytes_per_s(self) -> float:
        """Bound on the rate: what the link carries, and at most the window per base time of a message plus QUEUE_S."""
        within_s = self.alone_s + tuned.QUEUE_S if self._round_trips else 1.0
        return min(self.window / within_s, 1.0 / self._per_byte_s)


class Visitor:
    """The state of one visitor's stream. All times are seconds of one clock."""

    def __init__(self) -> None:
        self.link = LinkWindow()
        self._number = 0
        self._field = -1
        self._serial = -1  # of the newest publication sent
        self._status_s = -np.inf  # when it was told last
        self._moving_s = -np.inf  # when the next moving set is due
        self._anchors = -1  # number of the set of anchors whose knots were sent
        self._whole: MovingBlock | None = None  # the moving set, once all of it was sent
        self._forget_static()

    def _forget_static(self) -> None:
        self._source: StaticRecords | None = None  # what is being sent
        self._set = 0  # counts what this visitor was sent; another number is another set
        self._sent = np.zeros(0, RECORD)
        self._known = np.zeros(0, np.bool_)
        self._due: list[int] = []  # chunks
        self._unseen: NDArray[np.bool_] | None = None  # as sent

    def acknowledged(self, number: int, now_s: float) -> None:
        """The visitor has read all messages up to this one."""
        self.link.acknowledged(number, now_s)

    def message(
        self, published: Published | None, present_s: float, status: dict[str, Any], now_s: float
    ) -> bytes | None:
        """What to send now; None: nothing new, or the link is full.

        published: None while there is nothing to draw.
        present_s: the present, seconds since the run began. status: what all visitors are told; the link's is added.
        """
        if self.link.room < tuned.LEAST_WINDOW // 4:
            self.link.short = True
            return None
        room = self.link.room
        self.link.short = False
        blocks: list[bytes] = []
        if published is not None and published.scene.field != self._field:
            self._field = published.scene.field
            self._forget_static()
            blocks.append(write_block(published.scene))
        told = now_s >= self._status_s + tuned.STATUS_EVERY_S
        if told:
            blocks.append(write_block(StatusBlock(status | {"link": self._link(published)})))
        room -= sum(map(len, blocks))
        if published is not None:
            blocks += self._newest(published, room, now_s)
        if not blocks:
            return None
        if told:
            self._status_s = now_s
        data = write_message(self._number, present_s, blocks)
        self.link.sent(self._number, len(data), now_s)
        self._number = (self._number + 1) & 0xFFFFFFFF
        return data

    def _newest(self, published: Published, room: int, now_s: float) -> list[bytes]:
        """Knots, moving set and static chunks, as far as there is room; the first static set alone."""
        first = self._set == 0 or (self._set == 1 and not self._known.all())
        blocks = [] if first else self._moving(published, room, now_s)
        blocks += self._static(published.static, min(room - sum(map(len, blocks)), self.link.share))
        return blocks + self._newly_unseen()

    def _moving(self, published: Published, room: int, now_s: float) -> list[bytes]:
        """Knots of a new publication, and the moving set when it is due."""
        knots, moving = published.knots, published.moving
        if knots is None or moving is None:
            return self._nothing_moves()
        blocks = [] if published.serial == self._serial else [write_block(knots)]
        if blocks and len(blocks[0]) > room:
            blocks.clear()
        others = knots.anchors != self._anchors
        due = moving is not self._whole and now_s >= self._moving_s
        cut = self._cut(moving, room - sum(map(len, blocks))) if others or due else None
        if others and (cut is None or not blocks):
            return []  # knots of other anchors apply to nothing that the visitor has: send them with their moving set
        if blocks:
            self._serial, self._anchors = published.serial, knots.anchors
        if cut is not None:
            blocks.append(write_block(cut))
            takes_s = len(blocks[-1]) / (tuned.MOVING_SHARE * self.link.bound_bytes_per_s)
            self._moving_s = now_s + max(tuned.MOVING_EVERY_S, takes_s)
            # A set that was cut is sent again when the link takes more, even if it stays the newest.
            self._whole = moving if len(cut.records) == len(moving.records) else None
        return blocks

    def _nothing_moves(self) -> list[bytes]:
        """An empty set, once, to replace the last moving set."""
        if self._anchors < 0:
            return []
        self._anchors, self._whole = -1, None
        return [write_block(EMPTY)]

    def _link(self, published: Published | None) -> dict[str, Any]:
        return {
            "bytes_per_s": round(self.link.rate_bytes_per_s),
            "round_trip_ms": round(1e3 * self.link.alone_s, 1),
            "shortest_ms": round(1e3 * self.link.round_trip_s, 1),
            "static": [len(self._sent), 0 if published is None else len(published.static.records)],
        }

    def _cut(self, moving: MovingBlock, room: int) -> MovingBlock | None:
        """The moving set's largest Gaussians, as many as the link can carry in time; None: not now."""
        link = self.link
        takes = room if link.scatters else link.bound_bytes_per_s * tuned.MOVING_EVERY_S
        count = min(len(moving.records), max(int(tuned.MOVING_SHARE * takes) // _MOVING_BYTES, tuned.LEAST_MOVING))
        if count * _MOVING_BYTES > room:
            link.short = True
            return None
        parts = moving.records[:count], moving.anchor[:count], moving.share[:count]
        return MovingBlock(moving.anchors, moving.scales, *parts)

    # --- what stands still --------------------------------------------------------------------

    def _static(self, newest: StaticRecords, room: int) -> list[bytes]:
        """Chunks that are due, as many as fit."""
        complete = bool(self._known.all())
        wider = complete and self._takes() > 2 * len(self._sent) < 2 * len(newest.records)
        if wider or (newest is not self._source and (complete or self._same(newest))):
            self._take(newest, wider)
        static, blocks = self._source, list[bytes]()
        if static is None:
            return blocks
        while self._due:
            first = self._due[0] * tuned.CHUNK
            records = static.records[first : min(first + tuned.CHUNK, len(self._sent))]
            room -= RECORD.itemsize * len(records) + _HEADS
            if room < 0:
                self.link.short = True
                break
            self._due.pop(0)
            blocks.append(write_block(StaticBlock(self._set, len(self._sent), first, static.scales, records)))
            self._sent[first : first + len(records)] = records
            self._known[first : first + len(records)] = True
        return blocks

    def _newly_unseen(self) -> list[bytes]:
        """Which Gaussians no camera has seen, once the visitor has all records."""
        static = self._source
        if static is None or static.unseen is None or static.unseen is self._unseen or not self._known.all():
            return []
        self._unseen = static.unseen
        return [write_block(UnseenBlock(self._set, static.unseen[: len(self._sent)]))]

    def _same(self, newest: StaticRecords) -> bool:
        return self._source is not None and newest.number == self._source.number

    def _takes(self) -> int:
        """Number of static Gaussians that the link can carry in the time of a new set."""
        return int(tuned.NEW_SET_S * self.link.bound_bytes_per_s) // RECORD.itemsize

    def _take(self, newest: StaticRecords, wider: bool) -> None:
        """Choose what to send of the newest records: changed chunks, ordered by the weight of what changed; or a whole
        new set, of its largest Gaussians if the link cannot carry all. wider: send a new set, because the link can now
        carry more."""
        if not self._same(newest) or wider:
            count = min(len(newest.records), max(self._takes(), tuned.CHUNK))
            self._set += 1
            self._unseen = None
            self._sent, self._known = np.zeros(count, RECORD), np.zeros(count, np.bool_)
        count = len(self._sent)
        changed = noticeable(self._sent, newest.records[:count]) | ~self._known
        share = _by_chunk(changed * newest.weight[:count]) / np.maximum(_by_chunk(newest.weight[:count]), 1e-30)
        share += 2.0 * (_by_chunk(~self._known) > 0)
        order = np.argsort(-share, kind="stable")
        self._due = [int(k) for k in order if share[k] > tuned.CHANGED_SHARE]
        self._source = newest


def _by_chunk(values: NDArray) -> NDArray[np.float64]:
    """Sums over the Gaussians of each chunk."""
    return np.add.reduceat(values.astype(np.float64), np.arange(0, len(values), tuned.CHUNK)) if len(values) else values
