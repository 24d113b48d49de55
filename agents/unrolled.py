"""Back-propagation through compiled episodes and a recurrent policy, written out step by step.

On small arrays nearly all the time of automatic differentiation goes into keeping its own record. Here the episodes'
part is compiled (:class:`~..envs.rollout.Rollout`), and the policy's is the chain rule by hand; the gradients are
those that torch finds.
"""

from collections.abc import Callable
from typing import Any

import numpy
import torch

from ..envs.environment import TaskVectorEnv
from ..envs.rollout import Rollout
from .gate import Gate

LIMIT = 10.0
"""Largest normalised observation that the policy sees."""


class UnrolledPolicy:
    """Answers of a :class:`~.bptt.RecurrentPolicy` to N episodes, kept to be differentiated.

    All that a GRU multiplies with its parameters is one matrix times one vector of what is shown, memory, and 1::

        [reset    ]   [input weights  memory weights  both biases ]   [shown ]
        [update   ] = [     "               "              "      ] @ [memory]
        [candidate]   [input weights        0         input bias  ]   [  1   ]
        [recalled ]   [      0        memory weights  memory bias ]

        memory' = candidate + update (memory - candidate),  candidate = tanh(candidate + reset recalled)

    Args:
        policy: whose parameters are used, and whose gradients are added to.
        envs: episodes.
        decisions: that are kept at once.
    """

    def __init__(self, policy: Any, envs: int, decisions: int) -> None:
        self._policy = policy
        self._fields, self._size = len(policy.mean), policy.gru.hidden_size
        dtype = policy.mean.numpy().dtype
        self._seen = numpy.ones((decisions + 1, self._fields + self._size + 1, envs), dtype)
        self._gates = numpy.zeros((decisions, 4 * self._size, envs), dtype)
        self._answer = numpy.zeros((decisions, len(policy.low), envs), dtype)
        self._of_gates = numpy.zeros((4 * self._size, envs), dtype)
        self._of_seen = numpy.zeros((self._fields + self._size, envs), dtype)
        self._of_hidden = numpy.zeros((self._size, envs), dtype)
        self._room = numpy.zeros((2 * self._size, envs), dtype)
        self._vanished = numpy.sqrt(numpy.finfo(dtype).tiny)

    def begin(self) -> None:
        """Forget everything."""
        self._seen[0, self._fields : -1] = 0.0

    def read(self) -> None:
        """Take the parameters as they are now."""
        policy, fields, size = self._policy, self._fields, self._size
        input, memory, input_bias, memory_bias = (part.detach().numpy() for part in policy.gru.parameters())
        self._matrix = matrix = numpy.zeros((4 * size, fields + size + 1), input.dtype)
        matrix[: 3 * size, :fields], matrix[: 3 * size, -1] = input, input_bias
        both = numpy.r_[: 2 * size, 3 * size : 4 * size]
        matrix[both, fields:-1] = memory
        matrix[both, -1] += memory_bias
        weight, bias = (part.detach().numpy() for part in policy.head.parameters())
        self._head = numpy.concatenate([weight, bias[:, None]], axis=1)
        mean, scale, low, high = (
            part.numpy()[:, None] for part in (policy.mean, policy.scale, policy.low, policy.high)
        )
        self._mean, self._scale, self._low, self._half = mean, scale, low, (high - low) * 0.5
        self._of_matrix, self._of_head = numpy.zeros_like(matrix), numpy.zeros_like(self._head)

    def forward(self, decision: int, observation: numpy.ndarray) -> numpy.ndarray:
        """Answer observations ``(fields, N)`` with actions ``(A, N)``."""
        fields, size, seen, gates = self._fields, self._size, self._seen[decision], self._gates[decision]
        shown, hidden, after = seen[:fields], seen[fields:-1], self._seen[decision + 1, fields:]
        numpy.subtract(observation, self._mean, out=shown, casting="same_kind")
        shown /= self._scale
        numpy.clip(shown, -LIMIT, LIMIT, out=shown)
        numpy.matmul(self._matrix, seen, out=gates)
        opened, candidate, recalled = gates[: 2 * size], gates[2 * size : 3 * size], gates[3 * size :]
        # The logistic function of x is (1 + tanh(x / 2)) / 2, and overflows nowhere.
        opened *= 0.5
        numpy.tanh(opened, out=opened)
        opened += 1.0
        opened *= 0.5
        candidate += numpy.multiply(opened[:size], recalled, out=self._room[:size])
        numpy.tanh(candidate, out=candidate)
        numpy.subtract(hidden, candidate, out=after[:-1])
        after[:-1] *= opened[size:]
        after[:-1] += candidate
        answer = self._answer[decision]
        numpy.tanh(self._head @ after, out=answer)
        return self._low + self._half * (1.0 + answer)

    def backward_from_here(self) -> None:
        """Let the gradient with respect to the memory as it is now be zero."""
        self._of_hidden[...] = 0.0

    def backward(self, decision: int, of_action: numpy.ndarray) -> numpy.ndarray:
        """Turn the gradient with respect to actions ``(A, N)`` into that with respect to observations.

        The last decision comes first.
        """
        fields, size, seen, gates = self._fields, self._size, self._seen[decision], self._gates[decision]
        hidden, after = seen[fields:-1], self._seen[decision + 1, fields:]
        opened, candidate, recalled = gates[: 2 * size], gates[2 * size : 3 * size], gates[3 * size :]
        reset, update = opened[:size], opened[size:]
        of_gates, answer = self._of_gates, self._answer[decision]
        of_opened, of_candidate = of_gates[: 2 * size], of_gates[2 * size : 3 * size]
        of_answer = (of_action * self._half * (1.0 - answer * answer)).astype(answer.dtype, copy=False)
        # Products of what has nearly vanished would fall below the smallest normal number, where processors are slow.
        of_answer *= numpy.abs(of_answer) > self._vanished
        self._of_head += of_answer @ after.T
        of_hidden, room = self._of_hidden, self._room
        of_hidden += numpy.matmul(self._head[:, :-1].T, of_answer, out=room[:size])
        of_hidden *= numpy.abs(of_hidden, out=room[:size]) > self._vanished
        numpy.subtract(1.0, update, out=of_candidate)
        of_candidate *= of_hidden
        slope = numpy.multiply(candidate, candidate, out=room[:size])
        of_candidate *= numpy.subtract(1.0, slope, out=slope)
        numpy.multiply(of_candidate, reset, out=of_gates[3 * size :])
        numpy.multiply(of_candidate, recalled, out=of_opened[:size])
        numpy.subtract(hidden, candidate, out=of_opened[size:])
        of_opened[size:] *= of_hidden
        slope = numpy.multiply(opened, opened, out=room)
        of_opened *= numpy.subtract(opened, slope, out=slope)
        self._of_matrix += of_gates @ seen.T
        of_seen = numpy.matmul(self._matrix[:, :-1].T, of_gates, out=self._of_seen)
        of_hidden *= update
        of_hidden += of_seen[fields:]
        of_shown = of_seen[:fields]
        of_shown *= numpy.abs(seen[:fields]) < LIMIT
        of_shown /= self._scale
        return of_shown

    def add_gradients(self, decisions: int) -> None:
        """Add the gradients of the parameters, and go on from the memory after so many decisions."""
        fields, size, of_matrix = self._fields, self._size, self._of_matrix
        both = numpy.r_[: 2 * size, 3 * size : 4 * size]
        gradients = (
            *(of_matrix[: 3 * size, :fields], of_matrix[both, fields:-1]),
            *(of_matrix[: 3 * size, -1], of_matrix[both, -1]),
            *(self._of_head[:, :-1], self._of_head[:, -1]),
        )
        parameters = (*self._policy.gru.parameters(), *self._policy.head.parameters())
        for parameter, gradient in zip(parameters, gradients, strict=True):
            added = torch.from_numpy(gradient.copy())
            parameter.grad = added if parameter.grad is None else parameter.grad + added
        self._seen[0, fields:-1] = self._seen[decisions, fields:-1]


class Unrolled:
    """Windows of decisions of N compiled episodes under a policy, flown and differentiated.

    Args:
        env: with compiled backend, continuous actions and autoreset mode "Disabled"; it gives the episodes and their
            noise.
        policy: a :class:`~.bptt.RecurrentPolicy`.
        truncation: most decisions of a window.
        reward: that is ascended, as in :mod:`~..envs.reward`: the agent's own part of it.
        gate: that decides whether the policy acts; a decision in which it does not, has no gradient.
        largest: see :func:`.bptt.descend_episodes`.
    """

    def __init__(
        self,
        env: TaskVectorEnv,
        policy: Any,
        truncation: int,
        reward: str = "cost",
        gate: Gate | None = None,
        largest: float | None = None,
    ) -> None:
        lanes: Any = env.fleet.only
        self._env, self._lanes, self._interval = env, lanes, env.task.decision_interval
        self._truncation, self._largest = min(truncation, env.last_decision), largest
        self._rollout = Rollout(env.model, reward, lanes.width, self._truncation * self._interval)
        self._policy = UnrolledPolicy(policy, env.num_envs, self._truncation)
        self._gate: Any = gate
        self._gate_memory: Any = None
        self._opened = numpy.ones((self._truncation, env.num_envs))
        fields = env.model.fields
        self._mean = [i for i, field in enumerate(fields) if field.over_interval == "mean"]
        self._last = [i for i, field in enumerate(fields) if field.over_interval != "mean"]

    def descend_episodes(self, descend: Callable[[], None]) -> float:
        """Fly one episode in every environment; see :func:`.bptt.descend_episodes`."""
        self._begin()
        total, last = 0.0, self._env.last_decision
        for first in range(0, last, self._truncation):
            window = min(self._truncation, last - first)
            total += window * self._add_gradients(window)
            descend()
        return total / last

    def _begin(self) -> None:
        self._observation = self._env.reset()[0].T
        self._rollout.load(self._lanes.state)
        self._policy.begin()
        self._gate_memory, self._start = None, numpy.ones(self._env.num_envs, dtype=bool)

    def _add_gradients(self, decisions: int) -> float:
        """Add the gradients of the mean cost of the coming decisions; return it.

        Raises:
            ValueError: if an action is no finite number.
        """
        rollout, policy, count, interval = self._rollout, self._policy, self._lanes.count, self._interval
        paid = 0.0
        policy.read()
        for decision in range(decisions):
            action = policy.forward(decision, self._observation)
            if self._gate is not None:
                action = self._through_gate(decision, action)
            mean: Any = 0.0
            for measurement in range(decision * interval, (decision + 1) * interval):
                rollout.action[measurement, :, :count] = action
                rollout.noise[measurement] = self._lanes.next_row()
                rollout.forward()
                paid += float(rollout.reward[:count].sum())
                if interval > 1:
                    mean = mean + rollout.shown[self._mean, :count]
            self._observation = rollout.shown[:, :count].copy()
            if interval > 1:
                self._observation[self._mean] = mean / interval
        if not numpy.isfinite(rollout.action[: decisions * interval]).all():
            raise ValueError("the policy has answered with what are no finite numbers")
        share = 1.0 / (count * decisions * interval)
        rollout.reward_adjoint[:count] = -share
        rollout.backward_from_here()
        policy.backward_from_here()
        rollout.shown_adjoint[...] = 0.0
        for decision in reversed(range(decisions)):
            of_action: Any = 0.0
            for measurement in reversed(range(decision * interval, (decision + 1) * interval)):
                rollout.backward(measurement)
                if interval > 1:
                    rollout.shown_adjoint[self._last] = 0.0
                of_action = of_action + rollout.action_adjoint[:, :count]
            if self._gate is not None:
                of_action = of_action * self._opened[decision]
            if self._largest is not None:
                size = numpy.sqrt((of_action * of_action).sum(axis=0)) / (share * interval)
                of_action *= self._largest / numpy.maximum(size, self._largest)
            rollout.shown_adjoint[:, :count] = policy.backward(decision, of_action)
            if interval > 1:
                rollout.shown_adjoint[self._mean] /= interval
        policy.add_gradients(decisions)
        rollout.go_on()
        return -paid * share

    def _through_gate(self, decision: int, action: numpy.ndarray) -> numpy.ndarray:
        """Hold back actions ``(A, N)`` where nothing is wrong, and remember where they are not."""
        chosen, opened, self._gate_memory = self._gate.choose(
            self._observation.T, action.T, self._gate_memory, self._start
        )
        self._start = numpy.zeros_like(self._start)
        self._opened[decision] = opened
        return chosen.T
