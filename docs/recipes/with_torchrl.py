"""PPO of TorchRL on the native vector environment.

python docs/recipes/with_torchrl.py
"""

import gymnasium as gym
import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import filtergym

ID, ENVS, UPDATES, EPISODES = "filtergym/ManeuveringTarget-v0", 128, 15, 200

torch.manual_seed(0)
# GymEnv(ID) is a single environment. TorchRL resets by itself and holds rewards in float32.
keywords = {"dtype": "float32", "autoreset_mode": "Disabled"}
env = GymWrapper(gym.make_vec(ID, num_envs=ENVS, **keywords))
fields, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
net = nn.Sequential(
    nn.Linear(fields, 64), nn.Tanh(), nn.Linear(64, 2 * actions), NormalParamExtractor("biased_softplus_0.3")
)
actor = ProbabilisticActor(
    TensorDictModule(net, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,
    return_log_prob=True,
)
critic = ValueOperator(nn.Sequential(nn.Linear(fields, 64), nn.Tanh(), nn.Linear(64, 1)))
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, normalize_advantage=True)
advantage = GAE(gamma=0.95, lmbda=0.9, value_network=critic)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

for data in Collector(env, actor, frames_per_batch=100 * ENVS, total_frames=100 * ENVS * UPDATES):
    advantage(data)
    data = data.flatten()
    for rows in torch.cat([torch.randperm(len(data)) for _ in range(5)]).split(2560):
        losses = loss(data[rows])
        optimizer.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"]).backward()
        optimizer.step()

mine = filtergym.FunctionPolicy(lambda shown: net(torch.tensor(shown, dtype=torch.float32))[0], "evidence")
cost = filtergym.evaluate(ID, {"mine": mine, "imm": "imm"}, episodes=EPISODES)["cost"].mean(
    ["episode", "time"]
)
print(f"cost against the paper's algorithm: {cost[0] / cost[1] - 1:+.1%}")
