"""Policies: which of the newest views an update uses, and how long to wait for younger ones.

``policy`` says what a policy is, ``registry`` makes one by name; ``fixed`` and ``wait`` hold the fixed ones.
``learned`` trains policies and runs them.
"""

from edge_server.scheduler.policy import STATE_PARTS, Epoch, Policy, SelectionWindow
from edge_server.scheduler.registry import (
    BANDIT,
    OFFERED,
    POLICIES,
    LivePolicies,
    make_policy,
    parse_policy,
    policy_help,
    resolve_checkpoint,
    short_name,
)

__all__ = [
    "BANDIT",
    "OFFERED",
    "POLICIES",
    "STATE_PARTS",
    "Epoch",
    "LivePolicies",
    "Policy",
    "SelectionWindow",
    "make_policy",
    "parse_policy",
    "policy_help",
    "resolve_checkpoint",
    "short_name",
]
