"""A learned estimator: a filter with a network inside, as plain arrays.

The filter is a bank of the environment (:class:`.TrainedBanks`), and the network is a learned policy that acts in it.
The interface has neither observations nor actions: measurements in, mean and covariance out.
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
    """Filter made of a bank and the network that steers it; missing values of a measurement count as zeros.

    ``interval`` is the number of measurements for which an action is held.
    """

    def __init__(self, model: Model, network: Policy, interval: int = 1) -> None:
        super().__init__(model, decider_of(model, network, interval))
        self.network = network

    def predict(self, state: PolicyFilterState, measurement: Any) -> PolicyFilterState:
        """Return the state predicted to a measurement, with zeros for missing values."""
        return super().predict(state, fill_missing(measurement))

    def update(self, state: PolicyFilterState, inputs: FilterInput) -> PolicyFilterState:
        """Run the network on a measurement, update the bank under its action, and return the state."""
        return super().update(state, FilterInput(fill_missing(inputs.measurement)))


def fill_missing(measurement: Any) -> Any:
    """Return a measurement with zeros in place of missing values; banks weight values by their availability."""
    return map_arrays(numpy.nan_to_num, measurement)


class EstimatorMaker:
    """Factory of a learned estimator; an evaluation calls it with a task.

    ``policy`` is the network's factory, for a model of the bank.
    """

    kind: ClassVar[Kind] = "estimator"
    traced_as: ClassVar[str] = "learned estimator"

    def __init__(self, bank: str, policy: Callable[[Model], Policy]) -> None:
        self.bank = bank
        self.policy = policy

    def __call__(self, task: Task) -> LearnedEstimator:
        """Return the learned estimator for a task."""
        model = Model(task, self.bank)
        return LearnedEstimator(model, self.policy(model.on_numpy()))
