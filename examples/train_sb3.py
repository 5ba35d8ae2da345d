"""Learn which cameras an update uses with Stable-Baselines3 (pip install stable-baselines3).

python examples/train_sb3.py room 2000
"""

import sys

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

import freshfield.gym

gymnasium.register_envs(freshfield.gym)
env = gymnasium.make("freshfield/Select-v0", scenario=sys.argv[1], decisions=16, steps=20, size=32)
model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, gamma=0.0, seed=0, verbose=1)
print("before:", evaluate_policy(model, env, n_eval_episodes=4))
model.learn(int(sys.argv[2]))
print("after: ", evaluate_policy(model, env, n_eval_episodes=4))
