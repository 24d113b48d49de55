"""PPO of Stable-Baselines3 on the native vector environment.

python docs/recipes/with_stable_baselines3.py
"""

import gymnasium as gym
from stable_baselines3 import PPO

import filtergym
from filtergym.agents import to_sb3

ID, ENVS, STEPS, EPISODES = "filtergym/ManeuveringTarget-v0", 128, 200_000, 200

# PPO("MlpPolicy", gym.make(ID)) works too, a tenth as fast.
envs = gym.make_vec(ID, num_envs=ENVS, autoreset_mode="SameStep")
keywords = {"n_steps": 100, "batch_size": 2560, "gamma": 0.95, "learning_rate": 1e-3}
model = PPO("MlpPolicy", to_sb3(envs), policy_kwargs={"log_std_init": -1.0}, seed=0, **keywords)
model.learn(STEPS)

cost = filtergym.evaluate(ID, {"mine": model, "imm": "imm"}, episodes=EPISODES)["cost"].mean(
    ["episode", "time"]
)
print(f"cost against the paper's algorithm: {cost[0] / cost[1] - 1:+.1%}")
