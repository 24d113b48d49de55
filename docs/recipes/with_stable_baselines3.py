"""Stable-Baselines3's PPO on single environments, then on the native vector environment.

python docs/recipes/with_stable_baselines3.py
"""

import gymnasium as gym
from stable_baselines3 import PPO

import filtergym
from filtergym.agents import to_sb3

ID, STEPS, EPISODES = "filtergym/ManeuveringTarget-v0", 20_000, 200

single = PPO("MlpPolicy", gym.make(ID, control="evidence"), n_steps=1024, gamma=0.95, seed=0)
single.learn(STEPS // 4)

envs = gym.make_vec(ID, num_envs=64, control="evidence", autoreset_mode="SameStep")
vector = PPO("MlpPolicy", to_sb3(envs), n_steps=64, batch_size=512, gamma=0.95, seed=0)
vector.learn(STEPS)

results = filtergym.evaluate(ID, {"single": single, "vector": vector, "imm": "imm"}, episodes=EPISODES)
cost = results["cost"].mean(["episode", "time"]).to_series()
print("cost against the paper's algorithm, %:", (100 * (cost / cost["imm"] - 1)).round(1).to_dict())
