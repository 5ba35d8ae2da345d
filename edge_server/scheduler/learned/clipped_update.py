"""The clipped update of PPO (5.23, 6.42): one for the schedulers and for the policy over viewpoints.

The algorithm evaluates the log-probabilities of its actions under the current weights; this module steps the weights.
The caller limits torch to one thread, so that the same arguments give the same weights bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from edge_server.scheduler.learned.learner_spec import Spec

# Bounds exp: larger ratios are far outside the clip anyway.
_MAX_LOG_RATIO = 20.0


@dataclass(frozen=True)
class Acted:
    """A batch of B actions that were taken. All float64 (B,).

    logps: log-probabilities under the policy that acted.
    advantages: how much better than expected each action was.
    returns: what V is to predict.
    """

    logps: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor


Evaluate = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""Indices (b,) -> log-probabilities of these actions under the current weights, entropies, and values V, each (b,)."""


@dataclass(frozen=True)
class UpdateFigures:
    """Figures of an update, means over the minibatches of its last pass.

    moved: approximate KL divergence from the policy that acted, in nats. clipped: share of ratios outside the clip.
    gradient: norm before clipping. steps: gradient steps taken. skipped: those left out because the gradient was not
    finite.
    """

    policy_loss: float
    value_loss: float
    entropy: float
    moved: float
    clipped: float
    gradient: float
    steps: int
    skipped: int


def clipped_update(
    spec: Spec,
    evaluate: Evaluate,
    acted: Acted,
    parameters: list[torch.Tensor],
    optimizer: torch.optim.Optimizer,
    rng: np.random.Generator,
) -> UpdateFigures:
    """Step ``parameters``: pass over the batch in minibatches until the policy has moved by ``spec.target_kl``, or
    ``spec.passes`` times. rng: draws the order of each pass."""
    steps, skipped = 0, 0
    seen: list[tuple[float, ...]] = []
    for _ in range(spec.passes):
        seen = []
        order = torch.tensor(rng.permutation(len(acted.logps)))
        for some in order.split(spec.minibatch):
            loss, figures = _loss(spec, evaluate(some), acted, some)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            gradient = torch.nn.utils.clip_grad_norm_(parameters, spec.max_gradient)
            if torch.isfinite(gradient):
                optimizer.step()
                steps += 1
            else:
                skipped += 1
            seen.append((*figures, gradient.item()))
        if np.mean([figures[3] for figures in seen]) > spec.target_kl:
            break
    policy, value, entropy, moved, clipped, gradient_norm = np.mean(seen, axis=0).tolist()
    return UpdateFigures(policy, value, entropy, moved, clipped, gradient_norm, steps, skipped)


def _loss(
    spec: Spec, present: tuple[torch.Tensor, torch.Tensor, torch.Tensor], acted: Acted, some: torch.Tensor
) -> tuple[torch.Tensor, tuple[float, ...]]:
    """The loss, (5.23) or (6.42) negated with V's error and the entropy bonus, and figures to report."""
    now, entropy, values = present
    advantages = acted.advantages[some]
    log_ratio = torch.clamp(now - acted.logps[some], -_MAX_LOG_RATIO, _MAX_LOG_RATIO)
    ratio = torch.exp(log_ratio)
    clipped = torch.clamp(ratio, 1.0 - spec.clip, 1.0 + spec.clip)
    policy_loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
    error = values - acted.returns[some]
    value_loss = (error * error).mean()
    loss = policy_loss + spec.value * value_loss - spec.entropy * entropy.mean()
    # This KL estimate is never negative and varies less than -log ratio.
    moved = (torch.expm1(log_ratio) - log_ratio).mean()
    outside = ((ratio - 1.0).abs() > spec.clip).double().mean()
    figures = (policy_loss, value_loss, entropy.mean(), moved, outside)
    return loss, tuple(figure.item() for figure in figures)
