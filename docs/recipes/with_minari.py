"""Episodes of a tuned policy as a Minari data set, loaded again; behaviour cloning from it, judged on unseen episodes.

python docs/recipes/with_minari.py

d3rlpy's ``MDPDataset`` takes the same arrays: use d3rlpy 2.8.0, as 2.8.1 needs Gymnasium 1.0.0.
"""

import os
import tempfile

os.environ.setdefault("MINARI_DATASETS_PATH", tempfile.mkdtemp())  # leave it out to keep the data set

import minari
import numpy as np
import torch
from torch import nn

import filtergym
from filtergym.offline import write_datasets

ID, POLICY = "filtergym/ManeuveringTarget-v0", "imm-tuned"
RECORDED, UPDATES, EPISODES = 1_000, 8_000, 500

[written] = write_datasets(ID, [POLICY], episodes=RECORDED)  # of the training split
dataset = minari.load_dataset(written.name)
episodes = list(dataset.iterate_episodes())
observations = torch.tensor(np.concatenate([e.observations[:-1] for e in episodes]), dtype=torch.float32)
actions = torch.tensor(np.concatenate([e.actions for e in episodes]))
print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps of", dataset.env_spec.kwargs)

torch.manual_seed(0)
torch.set_num_threads(1)  # so small a network is slower on more
actor = nn.Sequential(
    nn.Linear(observations.shape[1], 64),
    nn.ReLU(),
    nn.Linear(64, 64),
    nn.ReLU(),
    nn.Linear(64, actions.shape[1]),
)
optimizer = torch.optim.Adam(actor.parameters(), lr=3e-3)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, UPDATES)
for _ in range(UPDATES):
    rows = torch.randint(len(observations), (1024,))
    loss = nn.functional.mse_loss(actor(observations[rows]), actions[rows])
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    schedule.step()

policy = filtergym.make_policy(
    ID, POLICY
)  # it acts in a control, and in a task, of its own: so does its clone
cloned = filtergym.FunctionPolicy(
    lambda o: actor(torch.tensor(o, dtype=torch.float32)), policy.control, policy.task_keywords
)
results = filtergym.evaluate(ID, {"cloned": cloned, POLICY: POLICY, "imm": "imm"}, episodes=EPISODES)
cost = results["cost"].mean(["episode", "time"])
results.attrs["paper"] = POLICY  # what the others are compared with
[difference] = [
    record
    for record in filtergym.tidy_records(results)
    if record.policy == "cloned" and record.metric == "relative_cost_difference"
]
low, high = difference.low, difference.high
print(f"cost against what was cloned: {difference.value:+.1%}, interval from {low:+.1%} to {high:+.1%}")
print(
    f"cost against the paper's algorithm: {cost[0] / cost[2] - 1:+.1%}, of what was cloned {cost[1] / cost[2] - 1:+.1%}"
)
