"""Episodes of the paper's policy as a Minari data set, loaded again; behaviour cloning from it.

python docs/recipes/with_minari.py
"""

import os
import tempfile

os.environ.setdefault("MINARI_DATASETS_PATH", tempfile.mkdtemp())  # leave it out to keep the data set

import gymnasium as gym
import minari
import torch
from torch import nn

import filtergym

ID, DATASET = "filtergym/ManeuveringTarget-v0", "filtergym/maneuvering-target/ramp-v0"
POLICY = "adaptive-rearm-tuned"  # a tuned ramp of the gain after every detected manoeuvre
RECORDED, UPDATES, EPISODES = 100, 2_000, 200

policy = filtergym.make_policy(ID, POLICY)
env = minari.DataCollector(gym.make(ID, **policy.keywords))
for seed in range(RECORDED):
    (observation, _), state, finished = env.reset(seed=seed), policy.begin([seed]), False
    while not finished:
        action, state = policy.predict(observation, state)
        observation, _, _, finished, _ = env.step(action.astype("float32"))  # Minari wants the space's type
env.create_dataset(DATASET, algorithm_name=POLICY, author="filtergym", eval_env=ID)

dataset = minari.load_dataset(DATASET)
episodes = list(dataset.iterate_episodes())
observations = torch.cat([torch.tensor(e.observations[:-1], dtype=torch.float32) for e in episodes])
actions = torch.cat([torch.tensor(e.actions, dtype=torch.float32) for e in episodes])
print(
    dataset.total_episodes,
    "episodes,",
    dataset.total_steps,
    "steps of",
    dataset.recover_environment().spec.id,
)

torch.manual_seed(0)
actor = nn.Sequential(nn.Linear(observations.shape[1], 64), nn.Tanh(), nn.Linear(64, actions.shape[1]))
optimizer = torch.optim.Adam(actor.parameters(), lr=3e-3)
for _ in range(UPDATES):
    rows = torch.randint(len(observations), (256,))
    loss = nn.functional.mse_loss(actor(observations[rows]), actions[rows])
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

cloned = filtergym.FunctionPolicy(lambda o: actor(torch.tensor(o, dtype=torch.float32)), policy.control)
names = {"cloned": cloned, POLICY: POLICY, "imm": "imm"}
cost = filtergym.evaluate(ID, names, episodes=EPISODES)["cost"].mean(["episode", "time"])
cloned, recorded = cost[0] / cost[2] - 1, cost[1] / cost[2] - 1
print(f"cost against the paper's algorithm: {cloned:+.1%}, of what was recorded {recorded:+.1%}")
