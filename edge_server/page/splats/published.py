"""Encodes the field's publications as records, once for all visitors."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.layers import layer_constants as layers
from edge_server.fields.splat.layers.motion import Motion
from edge_server.fields.splat.layers.snapshot import LayeredSnapshot, MovingSnapshot
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.page.splats import splat_stream_constants as tuned
from edge_server.page.splats.messages import MOST_ANCHORS, KnotsBlock, MovingBlock, SceneBlock
from edge_server.page.splats.records import scale_range, to_records, weights


@dataclass(frozen=True)
class StaticRecords:
    """The static Gaussians, largest weight first.

    number: counts sets of different Gaussians; within a set, row k stays the same Gaussian.
    records: RECORD (N,). weight: float64 (N,). unseen: bool (N,), see
    ``SurfaceScene.unseen_points``; None without depth.
    """

    number: int
    scales: tuple[float, float]
    records: NDArray[np.void]
    weight: NDArray[np.float64]
    unseen: NDArray[np.bool_] | None


@dataclass(frozen=True)
class Published:
    """A publication. serial: counts publications. moving: largest weight first; None if nothing moves, like knots."""

    serial: int
    scene: SceneBlock
    static: StaticRecords
    moving: MovingBlock | None
    knots: KnotsBlock | None


class Publisher:
    """Turns snapshots into ``Published``. start_ns: begin of the run, from which the stream's seconds count; on the
    clock of frames."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._snapshot: object = None
        self._behind = False  # whether static records are of an earlier snapshot, because it was too soon for new ones
        self._newest: Published | None = None
        self._box: SceneBox | None = None
        self._fields = self._anchor_sets = self._sets = 0
        self._anchors: NDArray[np.float64] | None = None
        self._order = np.zeros(0, np.intp)
        self._places = np.zeros((0, 3), np.float32)
        self._set_since_s = self._static_due_s = -np.inf

    def take(self, snapshot: object, now_s: float) -> Published | None:
        """The newest publication as records. None: the field does not consist of Gaussians. now_s: any clock."""
        if not isinstance(snapshot, SplatSnapshot):
            return None
        if snapshot is self._snapshot and not self._behind:
            return self._newest
        layered = snapshot if isinstance(snapshot, LayeredSnapshot) and snapshot.static is not None else None
        moving = None if layered is None else layered.moving
        before = self._newest
        if snapshot.box != self._box:
            self._box = snapshot.box
            self._fields += 1
            before = None
        params = snapshot.params if layered is None or layered.static is None else layered.static
        static = self._static(params, None if before is None else before.static, now_s, layered)
        box = snapshot.box
        if snapshot is self._snapshot and before is not None and static is before.static:
            return self._newest
        red, green, blue = map(float, snapshot.background)
        scene = SceneBlock(self._fields, box.center_m, box.radius_m, box.near_m / box.radius_m, (red, green, blue))
        records, knots = (None, None) if moving is None else self._moving(moving)
        serial = 0 if self._newest is None else self._newest.serial + 1
        self._snapshot = snapshot
        self._newest = Published(serial, scene, static, records, knots)
        return self._newest

    def _static(
        self, params: NDArray[np.float32], before: StaticRecords | None, now_s: float, layered: LayeredSnapshot | None
    ) -> StaticRecords:
        kept = before if before is not None and self._same(params) else None
        due_s = self._static_due_s
        if kept is None:
            due_s = max(due_s, self._set_since_s + tuned.NEW_SET_EVERY_S)
        self._behind = before is not None and now_s < due_s
        if before is not None and now_s < due_s:
            return before
        began = perf_counter()
        if kept is None:
            self._sets += 1
            self._set_since_s = now_s
            self._order = np.argsort(-weights(params), kind="stable")
        self._places = params[:: max(len(params) // tuned.SAMPLED, 1), :3].copy()
        params = params[self._order]
        scales = scale_range(params) if kept is None else kept.scales
        unseen = None if kept is None else kept.unseen
        if layered is not None and layered.surfaces is not None and unseen is None:
            box = layered.box
            unseen = layered.surfaces.unseen_points(params[:, :3] * box.radius_m + np.asarray(box.center_m))
        records = to_records(params, scales)
        made = StaticRecords(self._sets, scales, records, weights(params), unseen)
        self._static_due_s = now_s + max(tuned.STATIC_EVERY_S, tuned.BUSY * (perf_counter() - began))
        return made

    def _same(self, params: NDArray[np.float32]) -> bool:
        """Whether these are the Gaussians of the last set, trained further: none was added, removed or reordered."""
        if len(params) != len(self._order):
            return False
        places = params[:: max(len(params) // tuned.SAMPLED, 1), :3]
        return bool(np.median(np.linalg.norm(places - self._places, axis=1)) < tuned.SAME_WITHIN)

    def _moving(self, moving: MovingSnapshot) -> tuple[MovingBlock | None, KnotsBlock | None]:
        motion: Motion = moving.motion
        if motion.anchors is None or not len(moving.params) or len(motion.anchors) > MOST_ANCHORS:
            return None, None
        if motion.anchors is not self._anchors:
            self._anchors = motion.anchors
            self._anchor_sets += 1
        order = np.argsort(-weights(moving.params), kind="stable")
        params = moving.params[order]
        scales = scale_range(params)
        share = np.rint(moving.share[order] * 255.0).astype(np.int32)
        share[:, 1] = np.minimum(share[:, 1], 255 - share[:, 0])
        block = MovingBlock(
            self._anchor_sets,
            scales,
            to_records(params, scales),
            moving.anchor[order].astype(np.uint8),
            share[:, :2].astype(np.uint8),
        )
        first, knots = motion.newest_knots(tuned.KNOTS_SENT)
        rate, begin_s = float(layers.KNOTS_PER_S), (moving.origin_ns - self._start_ns) / 1e9
        instants = begin_s + first / rate, rate, begin_s + moving.newest_s
        return block, KnotsBlock(self._anchor_sets, *instants, layers.MAX_AHEAD_S, knots)
