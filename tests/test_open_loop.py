"""No held-out flight can be learned by heart: what is a function of the step number alone wins little.

The strongest such schedule of gains is found by gradient through the filter, on training episodes of the very scenario.
Here with few of them; ``python tests/test_open_loop.py`` does it thoroughly for all held-out flights and ``paper``.
"""

import sys

import numpy as np
import pytest
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.engine.lanes import Lanes
from filtergym.evaluation.competitors.kinds import Policy
from filtergym.evaluation.running.seeds import episode_seeds
from models import make_model

from filtergym import evaluate, tidy_records

ID = "filtergym/ManeuveringTarget-v0"


def best_schedule(scenario, episodes, iterations):
    """Actions by step number that cost least on average over training episodes, ``(decisions, actions)``."""
    import torch

    model = make_model(ID, "gain", scenario, backend="torch")
    seeds = episode_seeds("train", 0, episodes)
    decisions = model.task.horizon // model.task.decision_interval
    actions = torch.zeros((decisions, model.action_space.shape[0]), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([actions], lr=0.15)
    for _ in range(iterations):
        lanes = Lanes(model, episodes)
        for lane, seed in enumerate(seeds):
            lanes.seed(lane, np.random.default_rng(seed))
        lanes.restart()
        costs = []
        for k in range(decisions):
            for state, _ in lanes.decide(actions[k].expand(episodes, -1)):
                costs.append(model.cost(state)[:episodes].mean())
        optimiser.zero_grad()
        # The logarithm, so that the step does not depend on the size of the cost.
        torch.stack(costs).mean().log().backward()
        optimiser.step()
        with torch.no_grad():
            actions.clamp_(-1.0, 1.0)
    return actions.detach().numpy()


class OpenLoop(Policy):
    """Plays a schedule."""

    control = "gain"
    schedule: np.ndarray

    def act(self, observation, state, start):
        step = np.where(start, 0, 0 if state is None else state + 1)
        return self.schedule[step], step


def scores(scenario, episodes, training_episodes, iterations):
    """Scores of the best schedule and of the shipped agents."""
    player = type("Player", (OpenLoop,), {"schedule": best_schedule(scenario, training_episodes, iterations)})
    names = {name: name for name in ("imm", "bptt", "ppo", "known-turn")}
    records = tidy_records(evaluate(ID, {"schedule": player, **names}, scenario, episodes=episodes))
    return {r.policy: r.value for r in records if r.metric == "score"}


@pytest.mark.claims
def test_a_schedule_wins_less_than_half_of_what_an_agent_wins():
    pytest.importorskip("torch")
    found = scores("cruise", 300, 32, 20)
    assert found["schedule"] < 0.5 * max(found["bptt"], found["ppo"])


if __name__ == "__main__":
    for scenario in sys.argv[1:] or [s.name for s in catalogue()[ID].scenarios.values() if not s.training]:
        rounded = {name: round(value, 2) for name, value in scores(scenario, 2000, 128, 100).items()}
        print(scenario, rounded, flush=True)
