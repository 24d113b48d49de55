"""PPO of Tianshou on single environments.

python docs/recipes/with_tianshou.py

Tianshou needs pandas below 3, and its high-level interface ``tianshou[eval]``.
"""

import gymnasium as gym
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

import filtergym

ID, ENVS, STEPS, EPISODES = "filtergym/ManeuveringTarget-v0", 16, 40_000, 200

torch.manual_seed(0)
envs = DummyVectorEnv([lambda: gym.make(ID) for _ in range(ENVS)])
fields, actions = envs.observation_space[0].shape, envs.action_space[0].shape
net = Net(state_shape=fields, hidden_sizes=[64])
actor = ContinuousActorProbabilistic(preprocess_net=net, action_shape=actions, unbounded=True)
torch.nn.init.constant_(actor.sigma_param, -1.0)  # log of the exploration's standard deviation
policy = ProbabilisticActorPolicy(
    actor=actor,
    dist_fn=lambda loc_scale: torch.distributions.Independent(torch.distributions.Normal(*loc_scale), 1),
    deterministic_eval=True,
    action_space=envs.action_space[0],
)
critic = ContinuousCritic(preprocess_net=Net(state_shape=fields, hidden_sizes=[64]))
algorithm = PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.95)
algorithm.run_training(
    OnPolicyTrainerParams(
        training_collector=Collector(algorithm, envs, VectorReplayBuffer(100 * ENVS, ENVS)),
        max_epochs=1,
        epoch_num_steps=STEPS,
        collection_step_num_env_steps=100 * ENVS,
        batch_size=320,
        update_step_num_repetitions=5,
        verbose=False,
        show_progress=False,
    )
)


def act(shown):
    with torch.no_grad():
        return policy.map_action(policy.eval()(Batch(obs=shown, info={})).act)


names = {"mine": filtergym.FunctionPolicy(act, "evidence"), "imm": "imm"}
cost = filtergym.evaluate(ID, names, episodes=EPISODES)["cost"].mean(["episode", "time"])
print(f"cost against the paper's algorithm: {cost[0] / cost[1] - 1:+.1%}")
