"""PPO in a loop of one's own, as in CleanRL: torch on the native vector environment.

python docs/recipes/with_a_loop_of_ones_own.py

With "NextStep", Gymnasium's default, the step after the last one of an episode only resets: leave it out of the loss.
With "SameStep" the last observation is in ``info["final_obs"]``.
"""

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import filtergym

ID, ENVS, UPDATES, EPISODES = "filtergym/ManeuveringTarget-v0", 128, 40, 200
GAMMA, LAMBDA, CLIP = 0.95, 0.9, 0.2

torch.manual_seed(0)
keywords = {"dtype": "float32", "autoreset_mode": "SameStep"}
envs = gym.make_vec(ID, num_envs=ENVS, **keywords)
length, fields = envs.spec.max_episode_steps, envs.single_observation_space.shape[0]
actor = nn.Sequential(nn.Linear(fields, 64), nn.Tanh(), nn.Linear(64, envs.single_action_space.shape[0]))
critic = nn.Sequential(nn.Linear(fields, 64), nn.Tanh(), nn.Linear(64, 1), nn.Flatten(-2, -1))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)

observation = envs.reset(seed=0)[0]
for _ in range(UPDATES):  # each on one episode of every sub-environment
    steps = []
    for _ in range(length):
        shown = torch.tensor(observation)
        action = torch.normal(actor(shown).detach(), 0.3)
        observation, reward, _, _, info = envs.step(action)
        steps.append((shown, action, torch.tensor(reward)))
    shown, action, reward = map(torch.stack, zip(*steps, strict=True))
    with torch.no_grad():  # episodes are truncated: the last observation has a value
        old = torch.distributions.Normal(actor(shown), 0.3).log_prob(action).sum(-1)
        value = critic(torch.cat([shown, torch.tensor(np.stack(info["final_obs"]))[None]]))
    advantage, following = torch.zeros(length, ENVS), torch.zeros(ENVS)
    for t in reversed(range(length)):
        following = reward[t] + GAMMA * value[t + 1] - value[t] + GAMMA * LAMBDA * following
        advantage[t] = following
    data = [part.flatten(0, 1) for part in (shown, action, old, advantage, advantage + value[:-1])]
    for rows in torch.cat([torch.randperm(length * ENVS) for _ in range(5)]).split(2560):
        shown, action, old, advantage, target = (part[rows] for part in data)
        ratio = (torch.distributions.Normal(actor(shown), 0.3).log_prob(action).sum(-1) - old).exp()
        gain = (advantage - advantage.mean()) / advantage.std()
        loss = -torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
        optimizer.zero_grad()
        (loss + nn.functional.smooth_l1_loss(critic(shown), target)).backward()
        optimizer.step()

mine = filtergym.FunctionPolicy(lambda shown: actor(torch.tensor(shown, dtype=torch.float32)), "evidence")
cost = filtergym.evaluate(ID, {"mine": mine, "imm": "imm"}, episodes=EPISODES)["cost"].mean(
    ["episode", "time"]
)
print(f"cost against the paper's algorithm: {cost[0] / cost[1] - 1:+.1%}")
