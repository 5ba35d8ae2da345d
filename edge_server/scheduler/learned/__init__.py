"""The scheduler that learns (thesis 5.4, 6.3): one-step decisions, rewarded by what the field then shows.

    state.py         what a decision is made from (5.17, 6.33), and as numbers for a network
    observe.py       the state of a buffer
    spec.py          everything that defines a learner, as data
    networks.py      actors and values, any number of cameras with one set of weights
    distributions.py log-probabilities that hold at the edges, non-empty sets
    ppo.py           single-step PPO (5.23, algorithm 1), contextual-bandit PPO (6.42, algorithm 2)
    rewards.py       (5.19) and (6.36)-(6.38), term by term
    problem.py       what there is to learn: draw a decision, be rewarded
    environment.py   the same for gymnasium
    decide.py        an actor that has been learnt, in numpy
    bandit.py        a checkpoint as a policy, live and in virtual time
    apprentice.py    one that goes on learning while it is used, on a leash; lessons.py teaches it
    explain.py       what moved a decision
    record.py        decisions on disk, to be explained later

Only what learns needs torch: what decides at the edge is numpy.
"""
