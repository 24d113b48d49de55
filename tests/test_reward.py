"""What an agent is paid, beside the code: the cap on both costs, and the mean over a decision's measurements."""

import numpy as np
from filtergym.envs.catalogue import make_task
from filtergym.envs.environment import TaskVectorEnv
from filtergym.envs.lanes import Lanes
from filtergym.envs.reward import capped_cost, paper_task, reward
from filtergym.envs.task import huber

ID = "filtergym/ManeuveringTarget-v0"


def test_relative_reward_caps_the_papers_cost_too():
    task = make_task(ID, "gain")
    paper = paper_task(task)
    # So low that both costs are beyond it.
    task.huber_bound = paper.huber_bound = 1e-3
    lanes = Lanes(task, 8, paper)
    for lane in range(8):
        lanes.seed(lane, np.random.default_rng(lane))
    lanes.restart()
    paid = []

    def record(state, paper_state):
        costs = task.cost(state), paper.cost(paper_state)
        assert min(cost.min() for cost in costs) > 1e-6
        ours, theirs = (huber(cost, 1e-3, np) for cost in costs)
        np.testing.assert_array_equal(capped_cost(paper, paper_state), theirs)
        paid.append((reward("relative", task, state, paper, paper_state), theirs - ours))

    lanes.step(lambda state: task.act(state, np.full((1, 8), 0.5)), record)
    np.testing.assert_array_equal(*paid[0])


def test_one_decisions_reward_is_the_mean_over_its_measurements():
    long, short = (
        TaskVectorEnv(ID, 3, control="gain", horizon=12, decision_interval=interval) for interval in (4, 1)
    )
    for env in (long, short):
        env.reset(seed=0)
    action = np.full((3, 1), 0.3, np.float32)
    for _ in range(3):
        each = [short.step(action)[1] for _ in range(4)]
        np.testing.assert_allclose(long.step(action)[1], np.mean(each, axis=0), rtol=1e-14)
