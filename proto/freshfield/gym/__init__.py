"""Registers the environments of scheduling with gymnasium, when it is imported.

  import gymnasium
  import freshfield.gym

  env = gymnasium.make("freshfield/Select-v0", scenario="room")

or in one: ``gymnasium.make("freshfield.gym:freshfield/Wait-v0")``. Their arguments are those of
``edge_server.experiments.rollouts.environments``, which is imported only by ``make``.
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

_MODULE = "edge_server.experiments.rollouts.environments"

for _name in ("Select", "Wait"):
    if f"freshfield/{_name}-v0" not in registry:
        register(f"freshfield/{_name}-v0", entry_point=f"{_MODULE}:{_name}Env")
