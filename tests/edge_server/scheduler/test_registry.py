"""A policy and a treatment in one name: what is chosen does not change, what is chosen is treated."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from edge_server.scheduler import OFFERED, POLICIES, TREATMENTS, Epoch, make_policy, policy_help
from edge_server.scheduler.registry import VIRTUAL_ONLY

MS = 1_000_000
AT = Epoch(200 * MS, 0, {"a": 190 * MS, "b": 80 * MS, "c": 150 * MS})


def make(name: str, value: float | None = None, seed: int = 5):
    return make_policy(name, value, np.random.default_rng(seed))


@pytest.mark.parametrize("treatment", TREATMENTS)
@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_chooses_as_before_and_has_a_treatment(policy, treatment):
    alone, both = make(policy), make(f"{policy}+{treatment}")
    assert both.name == f"{policy}+{treatment}"
    assert (both.parameter, both.value) == (alone.parameter, alone.value)
    assert both.plan(AT) == alone.plan(AT)
    assert both.select(AT, both.plan(AT)) == alone.select(AT, alone.plan(AT))
    assert alone.treatment is None and both.treatment.name == treatment


@pytest.mark.parametrize("name", TREATMENTS)
def test_a_treatment_alone_uses_all(name):
    policy = make(name)
    assert policy.name == name and policy.parameter is None
    assert policy.select(AT, policy.plan(AT)) == ("a", "b", "c")


def test_the_value_is_the_policys():
    policy = make("threshold+mask", 60)
    assert policy.value == 60 and policy.plan(AT).omega_ms == 60
    assert policy.select(AT, policy.plan(AT)) == ("a", "c")
    with pytest.raises(ValueError, match="omega_ms: expected"):
        make("wait+freshen", -1)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("threshold+blur", "no treatment 'blur'; after the . choose one of mask, freshen"),
        ("threshold+mask+freshen", "no treatment 'mask.freshen'"),
        ("best+mask", "policy 'best' is not known"),
        ("+mask", "policy '' is not known"),
        ("mask+freshen", "policy 'mask' is not known"),
        ("threshold + mask", "policy 'threshold ' is not known"),
        ("freshn", "mask, freshen, or join a policy and a treatment, as in threshold.freshen"),
    ],
)
def test_a_name_that_cannot_be_is_refused_and_says_what_can(name, says):
    with pytest.raises(ValueError, match=says):
        make(name)
    assert policy_help(name) == ""


def test_all_that_is_offered_can_be_made_and_has_help():
    live = set(POLICIES) - set(VIRTUAL_ONLY)
    assert live | set(TREATMENTS) < set(OFFERED) and len(set(OFFERED)) == len(OFFERED)
    assert not set(VIRTUAL_ONLY) & set(OFFERED)
    for name in OFFERED:
        assert make(name).name == name and policy_help(name)
    assert policy_help("threshold+mask").endswith("; value: omega_ms")
    assert TREATMENTS["mask"][2] in policy_help("threshold+mask")


@pytest.mark.parametrize(("name", "treatment"), [("threshold", None), ("mask", "mask"), ("all+freshen", "freshen")])
def test_only_the_treatment_asked_for_is_imported(name, treatment):
    script = (
        "import sys, numpy as np; from edge_server.scheduler import make_policy;"
        f"make_policy({name!r}, None, np.random.default_rng(0));"
        "print(*(m.split('.')[-1] for m in sys.modules if m.startswith('edge_server.treatments.')))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    modules = {module for module, _, _ in TREATMENTS.values()} & set(done.stdout.split())
    assert modules == ({TREATMENTS[treatment][0]} if treatment else set())
    assert treatment or not done.stdout.strip()
