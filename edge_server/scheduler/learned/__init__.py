"""The learned scheduler (thesis 5.4, 6.3): one-step decisions, rewarded by the fidelity that the field then reaches.

    state.py                the state that a decision is made from (5.17, 6.33), and its features for a network
    observation.py          observes the state of a buffer
    learner_spec.py         everything that defines a learner, as data
    learning_constants.py   weights of the rewards, defaults of a specification, and what none sets
    networks.py             actor and value networks; one set of weights for any number of cameras
    distributions.py        log-probabilities, exact also near 0 and 1, of non-empty sets and of omegas
    ppo.py                  single-step PPO (5.23, algorithm 1), contextual-bandit PPO (6.42, algorithm 2)
    rewards.py              (5.19) and (6.36)-(6.38), term by term
    actor.py                a trained actor, in numpy
    bandit.py               a checkpoint as a policy, live and in virtual time
    explain.py              attributes a decision to parts of the state, cameras and image regions
    decision_record.py      decisions on disk, to be explained later

Only learning needs torch; deciding at the edge is numpy.
"""
