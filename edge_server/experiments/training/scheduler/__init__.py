"""Training of schedulers: decisions drawn from virtual deployments, rewarded by real field fits.

``setting`` says where decisions come from and what an evaluation is; ``episode`` draws decisions and carries
out what was chosen; ``crew`` does so in processes; ``choosing`` asks policies; ``trainer`` lets a learner
learn from it; ``contest`` compares what was learnt with everything else on seeds that were never trained on.
"""
