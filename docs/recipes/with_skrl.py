"""PPO of skrl on the native vector environment.

python docs/recipes/with_skrl.py
"""

import gymnasium as gym
import torch
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

import filtergym

ID, ENVS, STEPS, EPISODES = "filtergym/ManeuveringTarget-v0", 128, 1_500, 200


class Network(Model):
    def __init__(self, outputs):
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space)
        self.net = nn.Sequential(nn.Linear(self.num_observations, 64), nn.Tanh(), nn.Linear(64, outputs))


class Actor(GaussianMixin, Network):
    def __init__(self):
        Network.__init__(self, env.action_space.shape[0])
        GaussianMixin.__init__(self)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Network):
    def __init__(self):
        Network.__init__(self, 1)
        DeterministicMixin.__init__(self)

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {}


set_seed(0)
keywords = {"dtype": "float32", "autoreset_mode": "SameStep"}
env = wrap_env(gym.make_vec(ID, num_envs=ENVS, **keywords))
actor, critic = Actor(), Critic()
agent = PPO(
    models={"policy": actor, "value": critic},
    memory=RandomMemory(memory_size=100, num_envs=ENVS),
    observation_space=env.observation_space,
    action_space=env.action_space,
    cfg={
        "rollouts": 100,
        "mini_batches": 5,
        "discount_factor": 0.95,
        "experiment": {"write_interval": 0, "checkpoint_interval": 0},
    },
)
# Without headless skrl renders every step.
cfg = {"timesteps": STEPS, "headless": True, "disable_progressbar": True}
SequentialTrainer(env=env, agents=agent, cfg=cfg).train()

mine = filtergym.FunctionPolicy(lambda shown: actor.net(torch.tensor(shown, dtype=torch.float32)), "evidence")
cost = filtergym.evaluate(ID, {"mine": mine, "imm": "imm"}, episodes=EPISODES)["cost"].mean(
    ["episode", "time"]
)
print(f"cost against the paper's algorithm: {cost[0] / cost[1] - 1:+.1%}")
