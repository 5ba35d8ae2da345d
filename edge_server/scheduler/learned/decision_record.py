"""Stores decisions on disk, to be explained after a run: OUT/decisions/000123.npz.

A file holds one decision: state, action, and the embedded frames as delivered. Each policy is written once, as
policy-HASH.npz. Only the newest decisions that fit are kept.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import learning_constants as tuned
from edge_server.scheduler.learned.actor import Actor, Decision
from edge_server.scheduler.learned.state import State
from edge_server.scheduler.policy import Policy
from freshfield import payload
from freshfield.settings import as_mapping
from freshfield.untrusted import stored_bytes

if TYPE_CHECKING:  # imported at run time only where frames are embedded
    from edge_server.embed.settings import EmbeddingConfig

log = logging.getLogger(__name__)

FOLDER = "decisions"
_KIND = "decision"


class DecisionWriter:
    """Writes decisions under ``out``. A full disk costs decisions, counted in ``lost``, never the edge. Not
    thread-safe.

    embedding: settings of the embedder, to embed the frames again; None: nothing was embedded.
    """

    def __init__(self, out: Path, embedding: EmbeddingConfig | None = None) -> None:
        self._folder = out / FOLDER
        self._embedding = None if embedding is None else as_mapping(embedding)
        # Decision's file, policy's file, bytes written for it; those of an earlier process first.
        self._kept = deque((p, "", p.stat().st_size) for p in _numbered(self._folder))
        self.lost = 0

    def record(self, policy: Policy, number: int) -> None:
        """Write the decision of update ``number``, if ``policy`` is learned and took it."""
        decision = policy.last_decision
        if decision is not None and decision.number == number:
            self.write(decision)

    def write(self, decision: Decision) -> None:
        """Write a decision and drop the oldest ones that no longer fit."""
        path = self._folder / f"{decision.number:06d}.npz"
        try:
            self._drop_from(decision.number)
            policy, size = self._folder / f"policy-{decision.actor.digest[:12]}.npz", 0
            if not policy.exists():
                decision.actor.save(policy)
                size = policy.stat().st_size
            arrays, about = _as_arrays(decision, policy.name, self._embedding)
            checkpoint.save(path, arrays, about, _KIND, durable=False)
            self._kept.append((path, policy.name, path.stat().st_size + size))
            self._make_room()
        except OSError as error:
            self.lost += 1
            if self.lost == 1:
                log.warning("%s: cannot be written (%s): decisions are lost", path, error.strerror or error)

    def _drop_from(self, number: int) -> None:
        """Drop decisions from this number on: they belong to an earlier run in the same folder."""
        while self._kept and int(self._kept[-1][0].stem) >= number:
            self._kept.pop()[0].unlink(missing_ok=True)

    def _make_room(self) -> None:
        while len(self._kept) > 1 and (
            len(self._kept) > tuned.KEPT_DECISIONS or sum(size for *_, size in self._kept) > tuned.KEPT_DECISIONS_BYTES
        ):
            path, policy, _ = self._kept.popleft()
            path.unlink(missing_ok=True)
            if policy and all(policy != other for _, other, _ in self._kept):
                (self._folder / policy).unlink(missing_ok=True)


@dataclass(frozen=True)
class RecordedDecision:
    """A decision read from disk. images: the embedded frames, decoded, by camera. embedding: settings of
    their embedder; None where nothing was embedded."""

    decision: Decision
    images: dict[str, NDArray[np.uint8]]
    embedding: dict[str, Any] | None


def read_decision(run: Path, number: int | None = None) -> RecordedDecision:
    """Read the decision behind update ``number`` of the run in folder ``run``: its own, or the earlier one
    that its policy still held (``Spec.hold_ms``). number: None takes the newest. Raises ValueError if the
    decision is not kept, or its file is damaged."""
    known = _numbered(run / FOLDER)
    if not known:
        raise ValueError(
            f"{run}: no decisions are recorded: edge-server run, and simulate with --out, keep those of a "
            "learned policy (bandit:FILE)"
        )
    until = [path for path in known if number is None or int(path.stem) <= number]
    if not until:
        raise ValueError(f"{run}: the decision of update {number} is not kept; the oldest kept is {int(known[0].stem)}")
    path = until[-1]
    arrays, about = checkpoint.load(path, kind=_KIND, most_bytes=stored_bytes(path))
    try:
        actor = Actor.load(path.with_name(Path(about["policy"]).name))
        cameras = tuple(str(camera) for camera in about["cameras"])
        state = State(arrays["ages_ms"], arrays["poses"], arrays.get("embeddings"), arrays["reported"], cameras)
        decision = Decision(
            int(about["number"]), int(about["now_ns"]), state, arrays["action"], float(about["logp"]), actor
        )
        images = {}
        for camera, (codec, width, height) in about["frames"].items():
            try:
                images[camera] = payload.decode(arrays[f"frame.{camera}"].tobytes(), codec, width, height)
            except payload.PayloadError:
                continue  # it arrived damaged, so the policy did not see it
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: damaged: {error}") from None
    if number not in (None, decision.number) and not actor.spec.hold_ms:
        raise ValueError(
            f"{run}: update {number} has no decision of a learned policy; the last before it is that of "
            f"update {decision.number}"
        )
    return RecordedDecision(decision, images, about["embedding"])


def _as_arrays(
    decision: Decision, policy: str, embedding: dict[str, Any] | None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    s = decision.state
    arrays: dict[str, NDArray[Any]] = {
        "ages_ms": s.ages_ms,
        "poses": s.poses,
        "reported": s.reported,
        "action": decision.action,
    }
    if s.embeddings is not None:
        arrays["embeddings"] = s.embeddings
    for camera, frame in s.frames.items():
        arrays[f"frame.{camera}"] = np.frombuffer(frame.payload, np.uint8)
    about = {
        "number": decision.number,
        "now_ns": decision.now_ns,
        "logp": decision.logp,
        "cameras": list(s.cameras),
        "policy": policy,
        "embedding": embedding,
        "frames": {c: (f.codec, f.intrinsics.width, f.intrinsics.height) for c, f in s.frames.items()},
    }
    return arrays, about


def _numbered(folder: Path) -> list[Path]:
    """Decisions' files in a folder, oldest first."""
    return sorted((p for p in folder.glob("*.npz") if p.stem.isdigit()), key=lambda p: int(p.stem))
