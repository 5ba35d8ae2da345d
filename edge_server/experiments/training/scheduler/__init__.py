"""Training of schedulers: decisions drawn from virtual deployments, rewarded by real field fits.

``setting`` configures episodes and fits; ``episode`` draws decisions and carries out choices; ``workers``
does so in several processes; ``choices`` asks policies; ``trainer`` updates a learner from the rewards;
``evaluation`` compares the trained policy with all others on seeds that were never trained on.
"""
