"""A policy that is asked step by step, about any number of episodes, as an evaluation asks it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...compiler.functions import map_arrays, round_up_lanes
from ...envs.contract.model import Model
from ...envs.interface.requests import check_action
from .kinds import Policy
from .steered_filter import compile_policy, trace_decision

MODEL_ROWS = 128
"""Observations that a model of Stable-Baselines3 is asked about at once, always as many."""


class PolicyMemory(NamedTuple):
    """What a policy remembers between two steps."""

    calls: list[Any]
    """Of each call of the policy."""
    fresh: bool
    """Whether the episodes have yet to begin."""


class SteppingPolicy(Policy):
    """A policy for loops of one's own, where it answers what it answers in an evaluation, to the last bit.

    Matrix products round by their shape, and an episode must not depend on how many others there are. So the policy
    is asked about a multiple of eight observations, a model of Stable-Baselines3 always about as many, and the last
    one is repeated to fill up. A policy that is ``traceable`` is asked in compiled code where the model's steps are.

    Args:
        model: task with the bank that the policy steers.
        policy: anything with Stable-Baselines3's ``predict``.
        scenario: of the environment; None is its default.
        task_keywords: parameters of the task that the environment must be made with.
    """

    def __init__(
        self, model: Model, policy: Any, scenario: Any = None, task_keywords: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(model)
        self.policy = policy
        self.control = model.control  # type: ignore[misc]  # made for it
        self.scenario, self.task_keywords = scenario, dict(task_keywords or {})
        self._traced: Any = None
        self._is_traced = False

    @property
    def keywords(self) -> dict[str, Any]:
        """What ``gymnasium.make`` takes for an environment that the policy acts in."""
        scenario = {} if self.scenario is None else {"scenario": self.scenario}
        return {"control": self.control, **scenario, **self.task_keywords}

    def begin(self, seeds: Sequence[int]) -> PolicyMemory:
        """Return the state for the first :meth:`predict` of the episodes with these seeds.

        Only policies that draw numbers need it, ``random`` for one; for the others None does.
        """
        own = self.policy
        return PolicyMemory(
            [
                own.begin([seeds[i] for i in call]) if isinstance(own, Policy) else None
                for call in self._calls(len(seeds))
            ],
            True,
        )

    def predict(
        self,
        observation: numpy.ndarray,
        state: PolicyMemory | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[numpy.ndarray, PolicyMemory]:
        """Choose actions.

        Args:
            observation: ``(N, len(model.fields))``, or one observation without the batch axis.
            state: what the last call returned; at the first None, or what :meth:`begin` has returned.
            episode_start: ``(N,)`` booleans, or one; true where a new episode begins, as it does everywhere at the
                first call.
            deterministic: as in Stable-Baselines3.

        Returns:
            Actions, with the batch axis where the observation has it, and the state for the next call.

        Raises:
            ValueError: for a state of another number of episodes, or if the policy answers with no actions.
        """
        single = numpy.ndim(observation) == 1
        batch = numpy.atleast_2d(observation)
        calls = self._calls(len(batch))
        start = numpy.zeros(len(batch), dtype=bool)
        if state is None or state.fresh:
            start[:] = True
        elif episode_start is not None:
            start[:] = episode_start
        memories = [None] * len(calls) if state is None else state.calls
        if len(memories) != len(calls):
            raise ValueError(f"the state is not one of {len(batch)} episodes: begin anew with state=None")
        answers, kept = [], []
        for call, memory in zip(calls, memories, strict=True):
            answer, after = self._ask(batch[call], memory, start[call], deterministic)
            answers.append(check_action(self.model.action_space, answer, len(call)))
            kept.append(after)
        action = numpy.concatenate(answers)[: len(batch)]
        return (action[0] if single else action), PolicyMemory(kept, False)

    def _ask(
        self, observation: numpy.ndarray, memory: Any, start: numpy.ndarray, deterministic: bool
    ) -> tuple[Any, Any]:
        """Ask the policy, in code of the processor where it can be traced."""
        if not self._is_traced:
            self._traced, self._is_traced = compile_policy(self.model, self.policy, trace_decision), True
        if self._traced is None:
            answer: tuple[Any, Any] = self.policy.predict(
                observation, memory, start, deterministic=deterministic
            )
            return answer
        decide, nothing = self._traced
        width = len(observation)
        before = memory or map_arrays(lambda array: numpy.zeros((*array.shape[:-1], width)), nothing)
        action, after = decide(observation.T, before._replace(count=numpy.where(start, 0.0, 1.0)))
        return action.T, after

    def __getstate__(self) -> dict[str, Any]:
        """All but the code: a copy makes its own."""
        return {**self.__dict__, "_traced": None, "_is_traced": False}

    def _calls(self, count: int) -> list[numpy.ndarray]:
        """Episodes that each call of the policy is shown."""
        rows = MODEL_ROWS if hasattr(self.policy, "observation_space") else round_up_lanes(count)
        return [
            numpy.minimum(numpy.arange(first, first + rows), count - 1) for first in range(0, count, rows)
        ]
