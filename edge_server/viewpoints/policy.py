"""The thesis's policy over candidate viewpoints: PPO (4.9, 4.14) on a learned reward, with travel as a cost.

The network is the schedulers' pooled one (``scheduler.learned.networks``). Each candidate is a row: the
features of moving there next, the embedding of its picture once it is captured (4.8), its age and its pose.
The mean and the maximum over all rows are context. One logit per candidate makes a categorical distribution
over the open ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import State, StateLayout
from edge_server.viewpoints import viewpoint_constants as tuned
from edge_server.viewpoints.candidates import Candidates, ViewpointError
from edge_server.viewpoints.features import GEOMETRY, StepFeatures
from edge_server.viewpoints.registry import CaptureState
from freshfield.geometry import so3_log

Array = NDArray[np.float64]
Embed = Callable[[Sequence[NDArray[np.uint8]]], NDArray[np.float32]]

KIND = "viewpoint policy"


@dataclass(frozen=True)
class PolicyConfig:
    """How a policy is trained.

    views: number of views of an episode.
    updates: number of updates. episodes: number of episodes for each update.
    way: cost of a way as long as the candidates' mean distance from the target, in standard deviations of
        the reward of a step: the same plan for a large scene as for a small one.
    hidden, learning_rate: as in ``learner_spec.Spec``.
    """

    views: int = tuned.POLICY_VIEWS
    updates: int = tuned.POLICY_UPDATES
    episodes: int = tuned.POLICY_EPISODES
    way: float = tuned.WAY
    hidden: int = tuned.POLICY_HIDDEN
    learning_rate: float = tuned.POLICY_RATE


class Rows:
    """Turns a capture under way into the rows of a network.

    embeddings: (N, d), embeddings of the candidates' pictures; a row has its own only once it is captured.
        None: geometry only.
    """

    def __init__(self, candidates: Candidates, embeddings: Array | None, layout: StateLayout) -> None:
        self.steps = StepFeatures(candidates)
        self.embeddings, self.layout = embeddings, layout
        at = candidates.poses[:, :3, 3] - candidates.target
        self.far_m = max(float(np.linalg.norm(at, axis=1).mean()), 1e-12)
        at = at / self.far_m
        turns = np.stack([so3_log(pose[:3, :3]) for pose in candidates.poses])
        self._poses = np.column_stack([at, turns])

    def features(self, order: Sequence[int]) -> Array:
        """(N, width) after the views of ``order``."""
        candidates = self.steps.candidates
        ages = np.full(len(candidates), np.inf)
        for age, k in enumerate(reversed(order)):
            ages[k] = age * tuned.STEP_MS
        # What is not captured yet has the usual embedding, which is 0 once it is standardized.
        seen = np.tile(self.layout.center[len(GEOMETRY) :], (len(candidates), 1))
        if self.embeddings is not None and len(order):
            seen[list(order)] = self.embeddings[list(order)]
        both = np.column_stack([self.steps.actions(order), seen])
        return self.layout.features(State(ages, self._poses, both.astype(np.float32), candidates.reachable))


def layout_of(steps: StepFeatures, embeddings: Array | None, views: int, rng: np.random.Generator) -> StateLayout:
    """The layout with step features standardized over random captures of up to ``views`` views, and with
    ``embeddings`` (N, d) standardized over all candidates; None: without embeddings."""
    reachable = np.flatnonzero(steps.candidates.reachable)
    some = [
        steps.actions(rng.choice(reachable, min(t, len(reachable)), replace=False).tolist())[reachable]
        for t in range(1, views + 1)
    ]
    parts = [np.concatenate(some), *([] if embeddings is None else [embeddings])]
    center = np.concatenate([part.mean(axis=0) for part in parts])
    spread = np.concatenate([np.maximum(part.std(axis=0), 1e-3) for part in parts])
    return StateLayout(
        dim=len(center), age_scale_ms=tuned.STEP_MS, center=tuple(center.tolist()), spread=tuple(spread.tolist())
    )


@dataclass
class CandidatePolicy:
    """A trained policy as a selector: its values are logits.

    weights: weights of the actor.
    embed: pictures to embeddings, as in training; needed if the policy was trained with embeddings.
    """

    spec: Spec
    weights: dict[str, NDArray[np.float64]]
    embed: Embed | None = None
    name: str = "ppo"

    def values(self, state: CaptureState) -> Array:
        width = self.spec.layout.dim - len(GEOMETRY)
        embeddings = np.zeros((len(state.candidates), width))
        if width and self.embed is None:
            raise ViewpointError("this policy was trained with embeddings: give it the embedder")
        if width and self.embed is not None:
            embeddings[state.order] = self.embed([view.image for view in state.views])
        rows = Rows(state.candidates, embeddings, self.spec.layout).features(state.order)
        return np.asarray(networks.logits(np, self.spec, self.weights, rows[None])[0])

    def save(self, path: Path | str) -> None:
        """Write the policy. OSError where it cannot be written."""
        checkpoint.save(path, dict(self.weights), {"spec": self.spec.as_json()}, kind=KIND)

    @staticmethod
    def from_file(path: Path | str, embed: Embed | None = None) -> CandidatePolicy:
        """A policy as ``save`` left it. ViewpointError for anything else."""
        try:
            arrays, about = checkpoint.load(path, kind=KIND)
            spec = Spec.from_json(about["spec"])
            expected = networks.init_actor(spec, np.random.default_rng(0))
            if {k: v.shape for k, v in arrays.items()} != {k: v.shape for k, v in expected.items()}:
                raise ValueError("its weights do not fit its specification")
        except (OSError, ValueError, KeyError) as error:
            raise ViewpointError(f"{path}: not a viewpoint policy: {error}") from None
        return CandidatePolicy(spec, arrays, embed)


def train_policy(
    candidates: Candidates,
    reward: Callable[[Array], Array],
    config: PolicyConfig,
    seed: int = 0,
    embeddings: Array | None = None,
    embed: Embed | None = None,
) -> tuple[CandidatePolicy, list[float]]:
    """Train a policy. Returns it with the mean return of each update (figure 4.6).

    reward: maps step features (..., GEOMETRY) to rewards (...), such as ``RewardModel.reward``.
    embeddings: (N, d), embeddings of the candidates' pictures; the policy sees one once it is captured.
    embed: computes them when the policy is used.

    Raises ViewpointError for fewer reachable candidates than views, and for fewer than two views: the first
    is drawn.
    """
    import torch

    from edge_server.torch_threads import one_torch_thread

    usable = np.flatnonzero(candidates.reachable)
    if not 2 <= config.views <= len(usable):
        raise ViewpointError(
            f"{len(usable)} candidates can be reached, an episode has {config.views} views, at least 2"
        )
    rng = np.random.default_rng(seed)
    steps = StepFeatures(candidates)
    layout = layout_of(steps, embeddings, config.views, rng)
    spec = Spec(
        "select",
        layout,
        hidden=config.hidden,
        learning_rate=config.learning_rate,
        passes=tuned.PASSES,
        entropy=tuned.ENTROPY,
        target_kl=tuned.ANY_KL,
    )
    rows = Rows(candidates, embeddings, layout)
    usual = np.concatenate([reward(steps.actions([k]))[usable] for k in usable[:: max(len(usable) // 8, 1)]])
    # Rounding makes steps of equal reward differ by 1e-16: as a unit, it would blow the rewards up.
    spread = float(usual.std())
    scale = spread if spread > 1e-9 * float(np.abs(usual).max()) else 1.0
    actor = {k: torch.tensor(w, requires_grad=True) for k, w in networks.init_actor(spec, rng).items()}
    critic = {k: torch.tensor(w, requires_grad=True) for k, w in networks.init_value(spec, rng).items()}
    adam = torch.optim.Adam([*actor.values(), *critic.values()], lr=config.learning_rate)
    returns: list[float] = []
    with one_torch_thread():
        for _ in range(config.updates):
            mean, batch = _episodes(rows, reward, scale, config, _numpy(actor), _numpy(critic), spec, rng)
            returns.append(mean)
            _improve(batch, actor, critic, adam, spec, rng)
    return CandidatePolicy(spec, _numpy(actor), embed), returns


def _episodes(
    rows: Rows,
    reward: Callable[[Array], Array],
    scale: float,
    config: PolicyConfig,
    actor: dict[str, Any],
    critic: dict[str, Any],
    spec: Spec,
    rng: np.random.Generator,
) -> tuple[float, list[NDArray[Any]]]:
    """Episodes side by side: their mean return; and features, closed candidates, actions, log-probabilities, returns
    and values of all steps but the first, whose view is drawn."""
    count, way = config.episodes, GEOMETRY.index("way")
    usable = np.flatnonzero(rows.steps.candidates.reachable)
    orders = [[int(k)] for k in rng.choice(usable, count)]
    steps: list[tuple[NDArray[Any], ...]] = []
    for _ in range(config.views - 1):
        features = np.stack([rows.features(order) for order in orders])
        closed = np.tile(~rows.steps.candidates.reachable, (count, 1))
        for line, order in zip(closed, orders):
            line[order] = True
        logits = np.where(closed, tuned.CLOSED, networks.logits(np, spec, actor, features))
        logps = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
        chosen = np.argmax(logps + rng.gumbel(size=logps.shape), axis=1)
        taken = np.stack([rows.steps.actions(order)[k] for order, k in zip(orders, chosen)])
        gained = reward(taken) / scale - config.way * taken[:, way] / rows.far_m
        values = networks.value(np, critic, features)
        steps.append((features, closed, chosen, logps[np.arange(count), chosen], gained, values))
        for order, k in zip(orders, chosen):
            order.append(int(k))
    features, closed, chosen, logps, gained, values = (np.stack(part) for part in zip(*steps))
    total, returns = np.zeros(count), np.zeros_like(gained)
    for t in reversed(range(len(gained))):
        total = returns[t] = gained[t] + total
    kept = (features, closed, chosen, logps, returns, values)
    return float(gained.sum(axis=0).mean()), [part.reshape(-1, *part.shape[2:]) for part in kept]


def _improve(
    batch: list[NDArray[Any]],
    actor: dict[str, Any],
    critic: dict[str, Any],
    adam: Any,
    spec: Spec,
    rng: np.random.Generator,
) -> None:
    """The clipped update of PPO over a batch: a categorical over the open candidates."""
    import torch

    from edge_server.scheduler.learned.clipped_update import Acted, clipped_update

    features, closed, chosen, logps, returns, values = (torch.tensor(part) for part in batch)
    raw = returns - values
    acted = Acted(logps, (raw - raw.mean()) / max(raw.std(correction=0).item(), 1e-9), returns)

    def evaluate(some: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        logits = networks.logits(torch, spec, actor, features[some])
        logps = torch.log_softmax(logits.masked_fill(closed[some], tuned.CLOSED), dim=-1)
        now = logps.gather(1, chosen[some, None])[:, 0]
        entropy = -(logps.exp() * logps).masked_fill(closed[some], 0.0).sum(dim=-1)
        return now, entropy, networks.value(torch, critic, features[some])

    clipped_update(spec, evaluate, acted, [*actor.values(), *critic.values()], adam, rng)


def _numpy(weights: dict[str, Any]) -> dict[str, NDArray[np.float64]]:
    return {name: w.detach().numpy().copy() for name, w in weights.items()}
