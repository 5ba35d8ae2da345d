"""A policy of one's own, tried in a scenario's whole deployment in virtual time.

python examples/own_policy.py card 20
"""

import sys

import numpy as np

import freshfield as ff


class YoungestHalf(ff.Policy):
    """Use the younger half of the cameras' newest frames."""

    name = "youngest-half"

    def select(self, epoch, window):
        ages = sorted((epoch.age_ms(camera), camera) for camera in epoch.generated_ns)
        return tuple(camera for _, camera in ages[: (len(ages) + 1) // 2])


scenario, seconds = sys.argv[1], float(sys.argv[2])
for policy in ("all", YoungestHalf(None, np.random.default_rng(0))):
    trial = ff.try_policy(policy, scenario, seconds=seconds, seed=7)
    age_ms = trial.ages_ms[:, 1].mean()
    print(f"{trial.policy}: {trial.psnr_db:.2f} dB shown, frames {age_ms:.0f} ms old, {len(trial.decisions)} updates")
