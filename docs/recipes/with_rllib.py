"""PPO of RLlib (new API stack) on single environments, then on the native vector environment.

python docs/recipes/with_rllib.py

RLlib 2.60.0 needs Gymnasium 1.2.2, which works here too.
"""

import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns

import filtergym

ID, ENVS, UPDATES, EPISODES = "filtergym/ManeuveringTarget-v0", 64, 8, 200
keywords = {"dtype": "float32"}


def trained(vectorize_mode, updates):
    config = (
        PPOConfig()
        # The module before the colon is imported where the environment is made.
        .environment(f"filtergym:{ID}", env_config=keywords)
        .env_runners(num_env_runners=0, num_envs_per_env_runner=ENVS, gym_env_vectorize_mode=vectorize_mode)
        .training(train_batch_size=100 * ENVS, minibatch_size=1_280, num_epochs=5, gamma=0.95, lr=1e-3)
        .debugging(seed=0, log_level="ERROR")
    )
    algorithm = config.build_algo()
    for _ in range(updates):
        algorithm.train()
    module = algorithm.get_module()

    def act(shown):
        with torch.no_grad():
            answer = module.forward_inference({Columns.OBS: torch.tensor(shown, dtype=torch.float32)})
        return answer[Columns.ACTION_DIST_INPUTS][:, :2]  # means; the rest are logarithms of deviations

    return filtergym.FunctionPolicy(act, "evidence")


ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
names = {"single": trained("sync", 1), "vector": trained("vector_entry_point", UPDATES), "imm": "imm"}
cost = filtergym.evaluate(ID, names, episodes=EPISODES)["cost"].mean(["episode", "time"])
single, vector = cost[0] / cost[2] - 1, cost[1] / cost[2] - 1
print(
    f"cost against the paper's algorithm: {vector:+.1%}, after one update on single environments {single:+.1%}"
)
