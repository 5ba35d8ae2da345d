"""Training of schedulers by rollouts (``experiments.rollouts``), rewarded by real field fits.

``trainer`` updates a learner from the rewards; ``evaluation`` compares what was learned with all other policies on
seeds that were never trained on, for studies.
"""
