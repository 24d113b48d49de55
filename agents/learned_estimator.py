"""A learned estimator: a filter with a network inside, as plain arrays.

The filter is a bank of the environment (:class:`.TrainedBanks`), the network is a learned policy that acts in it. From
outside there is neither observation nor action: measurements go in, mean and covariance come out.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy

from ..compiler.functions import map_arrays
from ..envs.contract.filter import FilterInput
from ..envs.contract.model import Model
from ..envs.contract.task import Task
from ..evaluation.competitors.kinds import Kind, Policy
from ..evaluation.competitors.steered_filter import PolicyFilterState, SteeredFilter, decider_of


class LearnedEstimator(SteeredFilter):
    """A bank with the policy that closes it, given zero where nothing was received, as banks are.

    Args:
        model: with the bank.
        network: a policy made for the bank, on NumPy.
        interval: measurements for which an action holds.
    """

    def __init__(self, model: Model, network: Policy, interval: int = 1) -> None:
        super().__init__(model, decider_of(model, network, interval))
        self.network = network

    def predict(self, state: PolicyFilterState, measurement: Any) -> PolicyFilterState:
        """Predict in the bank."""
        return super().predict(state, fill_missing(measurement))

    def update(self, state: PolicyFilterState, given: FilterInput) -> PolicyFilterState:
        """Show the network what has come, and update as it answers."""
        return super().update(state, FilterInput(fill_missing(given.measurement)))


def fill_missing(measurement: Any) -> Any:
    """Put numbers in place of what is missing: banks weigh values by their availability."""
    return map_arrays(numpy.nan_to_num, measurement)


class EstimatorMaker:
    """Makes a learned estimator for a task; what an evaluation calls.

    Args:
        bank: name of the filter among the trained banks of the task.
        policy: what makes the network for a model of that bank.
    """

    kind: ClassVar[Kind] = "estimator"
    traced_as: ClassVar[str] = "learned estimator"

    def __init__(self, bank: str, policy: Callable[[Model], Policy]) -> None:
        self.bank = bank
        self.policy = policy

    def __call__(self, task: Task) -> LearnedEstimator:
        """Make it."""
        model = Model(task, self.bank)
        return LearnedEstimator(model, self.policy(model.on_numpy()))
