"""Back-propagation through compiled episodes and a small network, written out step by step.

On small arrays automatic differentiation spends nearly all its time on its own tape. Here the part of the episodes
is compiled (:class:`~..envs.rollout.Rollout`), and that of the policy is the chain rule by hand. The gradients equal
torch's.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy
import torch

from ..baselines.problem import Problem
from ..envs.contract.model import Episode, Model
from ..envs.contract.observation import Array, DecisionMeans
from ..envs.engine.compiled import can_step
from ..envs.engine.lanes import Lanes
from ..envs.engine.rollout import Rollout, TrainingObjective
from ..envs.interface.vector_environment import TaskVectorEnv
from ..evaluation.competitors.filters import close_loop
from ..evaluation.competitors.kinds import kind_of
from .gate import Gate

LIMIT = 10.0
"""Largest magnitude of a normalised observation."""


class UnrolledPolicy:
    """Forward and backward pass of a :class:`~.bptt.NetworkPolicy` over N episodes.

    ``decisions`` is the largest number of decisions between two backward passes.
    """

    def __init__(self, policy: Any, envs: int, decisions: int) -> None:
        self._policy, self._fields = policy, len(policy.mean)
        dtype = policy.mean.numpy().dtype
        # Observation, memory, and 1, the factor of the biases.
        self._seen = numpy.ones((decisions + 1, self._fields + policy.memory_size + 1, envs), dtype)
        self._memory = None if policy.gru is None else UnrolledMemory(policy.gru, self._seen)
        self._layers = UnrolledLayers(policy.layers, envs, decisions)

    def begin(self) -> None:
        """Set the recurrent memory to zero, at the start of episodes."""
        self._seen[0, self._fields : -1] = 0.0

    def read(self) -> None:
        """Copy the current parameters of the policy from torch to the NumPy arrays."""
        policy = self._policy
        self._mean, self._scale, self._used, self._low, high = (
            part.numpy()[:, None]
            for part in (policy.mean, policy.scale, policy.used, policy.low, policy.high)
        )
        self._half = (high - self._low) * 0.5
        self._layers.read()
        if self._memory is not None:
            self._memory.read()

    def forward(self, decision: int, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the actions ``(A, N)`` for observations ``(fields, N)``, and store what the backward pass needs."""
        seen = self._seen[decision]
        shown = seen[: self._fields]
        numpy.subtract(observation, self._mean, out=shown, casting="same_kind")
        shown /= self._scale
        numpy.clip(shown, -LIMIT, LIMIT, out=shown)
        shown *= self._used
        features = seen if self._memory is None else self._memory.forward(decision)
        return self._low + self._half * (1.0 + self._layers.forward(decision, features))

    def backward_from_here(self) -> None:
        """Set the gradient with respect to the current memory to zero, at the end of a window."""
        if self._memory is not None:
            self._memory.backward_from_here()

    def backward(self, decision: int, of_action: numpy.ndarray) -> numpy.ndarray:
        """Return the gradient with respect to observations ``(fields, N)`` from that for actions ``(A, N)``.

        Decisions are passed in reverse order.
        """
        of_features = self._layers.backward(decision, of_action * self._half)
        of_shown = of_features if self._memory is None else self._memory.backward(decision, of_features)
        of_shown *= numpy.abs(self._seen[decision, : self._fields]) < LIMIT
        of_shown *= self._used / self._scale
        return of_shown

    def add_gradients(self, decisions: int) -> None:
        """Add a window's gradients to those of torch's parameters, and continue from its last memory."""
        self._layers.add_gradients()
        if self._memory is not None:
            self._memory.add_gradients()
        self._seen[0, self._fields : -1] = self._seen[decisions, self._fields : -1]


class UnrolledLayers:
    """Linear layers, ``f([weights, bias] @ [features, 1])``; f is the rectifier, and tanh after the last of them."""

    def __init__(self, layers: Sequence[Any], envs: int, decisions: int) -> None:
        self._layers = layers
        dtype = layers[0].weight.detach().numpy().dtype
        self._outputs = [numpy.ones((decisions, len(layer.bias) + 1, envs), dtype) for layer in layers]
        self._inputs: list[Any] = [[None] * decisions, *self._outputs[:-1]]
        self._vanished = numpy.sqrt(numpy.finfo(dtype).tiny)

    def read(self) -> None:
        """Copy the current weights and biases from torch to the NumPy arrays, and clear the gradients."""
        pairs = [(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in self._layers]
        self._matrices = [numpy.concatenate([weight, bias[:, None]], axis=1) for weight, bias in pairs]
        self._of_matrices = [numpy.zeros_like(matrix) for matrix in self._matrices]

    def forward(self, decision: int, features: numpy.ndarray) -> numpy.ndarray:
        """Return the layers' outputs for features with a last row of ones.

        The features are stored by reference: they must not change before the backward pass.
        """
        self._inputs[0][decision] = features
        last = len(self._layers) - 1
        for i, matrix in enumerate(self._matrices):
            sums, output = matrix @ self._inputs[i][decision], self._outputs[i][decision, :-1]
            numpy.tanh(sums, out=output) if i == last else numpy.maximum(sums, 0.0, out=output)
        return output

    def backward(self, decision: int, gradient: numpy.ndarray) -> numpy.ndarray:
        """Return the gradient with respect to the features, from that with respect to the outputs of a decision."""
        last = len(self._layers) - 1
        for i in reversed(range(len(self._layers))):
            answer = self._outputs[i][decision, :-1]
            slope = 1.0 - answer * answer if i == last else answer > 0.0
            gradient = (gradient * slope).astype(answer.dtype, copy=False)
            # Products of tiny numbers fall below the smallest normal number, where processors are slow.
            gradient *= numpy.abs(gradient) > self._vanished
            self._of_matrices[i] += gradient @ self._inputs[i][decision].T
            gradient = self._matrices[i][:, :-1].T @ gradient
        return gradient

    def add_gradients(self) -> None:
        """Add the window's gradients to those of the layers' torch parameters."""
        for layer, of_matrix in zip(self._layers, self._of_matrices, strict=True):
            _add_gradient(layer.weight, of_matrix[:, :-1])
            _add_gradient(layer.bias, of_matrix[:, -1])


class UnrolledMemory:
    """Forward and backward pass of the gated recurrent unit of a policy.

    All products of a GRU with its parameters are one matrix times one vector of observation (shown), memory, and 1::

        [reset    ]   [input weights  memory weights  both biases ]   [shown ]
        [update   ] = [     "               "              "      ] @ [memory]
        [candidate]   [input weights        0         input bias  ]   [  1   ]
        [recalled ]   [      0        memory weights  memory bias ]

        memory' = candidate + update (memory - candidate),  candidate = tanh(candidate + reset recalled)

    Args:
        gru: GRU cell of torch.
        seen: observation, memory, and 1, ``(decisions + 1, fields + memory + 1, N)``; the memory is written there.
    """

    def __init__(self, gru: Any, seen: numpy.ndarray) -> None:
        self._gru, self._seen = gru, seen
        size, dtype = gru.hidden_size, seen.dtype
        decisions, width, envs = seen.shape
        self._fields, self._size = width - size - 1, size
        self._gates = numpy.zeros((decisions - 1, 4 * size, envs), dtype)
        self._of_gates = numpy.zeros((4 * size, envs), dtype)
        self._of_seen = numpy.zeros((width - 1, envs), dtype)
        self._of_hidden = numpy.zeros((size, envs), dtype)
        self._room = numpy.zeros((2 * size, envs), dtype)
        self._vanished = numpy.sqrt(numpy.finfo(dtype).tiny)

    def read(self) -> None:
        """Copy the current parameters of the GRU from torch to the NumPy arrays, and clear the gradients."""
        fields, size = self._fields, self._size
        input, memory, input_bias, memory_bias = (part.detach().numpy() for part in self._gru.parameters())
        self._matrix = matrix = numpy.zeros((4 * size, fields + size + 1), input.dtype)
        matrix[: 3 * size, :fields], matrix[: 3 * size, -1] = input, input_bias
        both = numpy.r_[: 2 * size, 3 * size : 4 * size]
        matrix[both, fields:-1] = memory
        matrix[both, -1] += memory_bias
        self._of_matrix = numpy.zeros_like(matrix)

    def forward(self, decision: int) -> numpy.ndarray:
        """Return the recurrent memory after a decision, with a last row of ones."""
        size, seen, gates = self._size, self._seen[decision], self._gates[decision]
        hidden, after = seen[self._fields : -1], self._seen[decision + 1, self._fields :]
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
        return after

    def backward_from_here(self) -> None:
        """Set the gradient with respect to the current memory to zero, at the end of a window."""
        self._of_hidden[...] = 0.0

    def backward(self, decision: int, of_after: numpy.ndarray) -> numpy.ndarray:
        """Return the gradient with respect to the observation, from that with respect to the memory after a decision.

        Args:
            decision: number of the decision; decisions are passed in reverse order.
            of_after: the part of the gradient that does not flow through later decisions.
        """
        fields, size, seen, gates = self._fields, self._size, self._seen[decision], self._gates[decision]
        hidden = seen[fields:-1]
        opened, candidate, recalled = gates[: 2 * size], gates[2 * size : 3 * size], gates[3 * size :]
        reset, update = opened[:size], opened[size:]
        of_gates, of_hidden, room = self._of_gates, self._of_hidden, self._room
        of_opened, of_candidate = of_gates[: 2 * size], of_gates[2 * size : 3 * size]
        of_hidden += of_after
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
        return of_seen[:fields]

    def add_gradients(self) -> None:
        """Add the window's gradients to those of the GRU's torch parameters."""
        fields, size, of_matrix = self._fields, self._size, self._of_matrix
        both = numpy.r_[: 2 * size, 3 * size : 4 * size]
        gradients = (
            *(of_matrix[: 3 * size, :fields], of_matrix[both, fields:-1]),
            *(of_matrix[: 3 * size, -1], of_matrix[both, -1]),
        )
        for parameter, gradient in zip(self._gru.parameters(), gradients, strict=True):
            _add_gradient(parameter, gradient)


def _add_gradient(parameter: Any, gradient: numpy.ndarray) -> None:
    added = torch.from_numpy(gradient.copy())
    parameter.grad = added if parameter.grad is None else parameter.grad + added


class Teacher:
    """A filter over the measurements of episodes, whose estimates are the targets of a student.

    Args:
        env: environments of the episodes, with compiled backend.
        name: name of one of the environment's own estimators, or of a reference, which knows the truth.

    Raises:
        ValueError: for an unknown name, a filter without compiled code, or a world that depends on the estimates.
    """

    def __init__(self, env: TaskVectorEnv, name: str) -> None:
        competitor = Problem.of(type(env.task)).competitor(name)
        kind = kind_of(competitor)
        if kind not in ("estimator", "reference"):
            raise ValueError(f"a teacher is an estimator or a reference, but {name!r} is of kind {kind}")
        if env.task.closes_loop:
            raise ValueError(
                f"{name!r} cannot teach in {env.task.id}: the measurements depend on its own estimates"
            )
        model = close_loop(env.model, competitor, kind, name, env.num_envs)
        if not can_step(model, _estimate):
            raise ValueError(f"{name!r} cannot teach: it does not run as compiled code")
        self._lanes = Lanes(model, env.num_envs, report=_estimate)

    def estimates(self, identities: numpy.ndarray) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Return the teacher's means ``(measurements, C, width)`` and covariances ``(measurements, C, C, width)``."""
        self._lanes.begin(identities[:, : self._lanes.count])
        found: tuple[numpy.ndarray, numpy.ndarray] = self._lanes.run(_estimate)[0]
        return found


def _estimate(model: Model, episode: Episode) -> tuple[Array, Array]:
    return model.mean(episode), model.covariance(episode)


COST = TrainingObjective("cost")


class Unrolled:
    """Simulation of N compiled episodes under a policy, and its gradients, in windows of decisions.

    Args:
        env: environments with compiled backend, continuous actions and autoreset mode "Disabled"; they give the
            episodes and their noise.
        policy: a :class:`~.bptt.NetworkPolicy`.
        truncation: most decisions of a window.
        reward: the reward to maximise: the agent's own part of it.
        teacher: teacher whose estimates are the targets of a share of the reward.
        gate: gate that decides whether the policy acts; other decisions have no gradient.
        largest: norm to which gradients are clipped, see :func:`.bptt.descend_episodes`.
        penalty: cost of a squared action of one, see :func:`.bptt.descend_episodes`.
    """

    def __init__(
        self,
        env: TaskVectorEnv,
        policy: Any,
        truncation: int,
        reward: TrainingObjective = COST,
        teacher: Teacher | None = None,
        gate: Gate | None = None,
        largest: float | None = None,
        penalty: float = 0.0,
    ) -> None:
        lanes: Any = env.fleet.only
        self._env, self._lanes, self._interval = env, lanes, env.task.decision_interval
        self._truncation, self._largest = min(truncation, env.last_decision), largest
        self._penalty = penalty
        self._rollout = Rollout(env.model, reward, lanes.width, self._truncation * self._interval)
        self._teacher, self._flown = teacher, 0
        self._policy = UnrolledPolicy(policy, env.num_envs, self._truncation)
        self._gate: Any = gate
        self._gate_memory: Any = None
        self._opened = numpy.ones((self._truncation, env.num_envs))
        fields = env.model.fields
        self._means = DecisionMeans(fields, self._interval)
        self._last = [i for i in range(len(fields)) if i not in self._means.columns]

    def descend_episodes(self, descend: Callable[[], None]) -> float:
        """Simulate an episode in every environment, with a gradient step after each window; return the mean cost."""
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
        if self._teacher is not None:
            self._targets, self._flown = self._teacher.estimates(self._lanes.noise.identities), 0
        self._policy.begin()
        self._gate_memory, self._start = None, numpy.ones(self._env.num_envs, dtype=bool)

    def _add_gradients(self, decisions: int) -> float:
        """Simulate the next decisions, add the gradients of their mean cost to the policy's, and return the cost.

        Raises:
            ValueError: if an action is not finite.
        """
        rollout, policy, count, interval = self._rollout, self._policy, self._lanes.count, self._interval
        reward = 0.0
        policy.read()
        if self._teacher is not None:
            window = slice(self._flown, self._flown + decisions * interval)
            for given, answers in zip(rollout.teacher, self._targets, strict=True):
                given[: decisions * interval] = answers[window].reshape(-1, *given.shape[1:])
            self._flown = window.stop
        for decision in range(decisions):
            action = policy.forward(decision, self._observation)
            if self._gate is not None:
                action = self._through_gate(decision, action)
            total: Any = 0.0
            for measurement in range(decision * interval, (decision + 1) * interval):
                rollout.action[measurement, :, :count] = action
                rollout.noise[measurement] = self._lanes.next_row()
                rollout.forward()
                reward += float(rollout.reward[:count].sum())
                total = self._means.add(total, rollout.shown[:, :count])
            self._observation = numpy.array(self._means.show(rollout.shown[:, :count], total, numpy))
        if not numpy.isfinite(rollout.action[: decisions * interval]).all():
            raise ValueError("the policy has returned actions that are not finite")
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
            if self._penalty > 0.0:
                action = rollout.action[decision * interval, :, :count]
                of_action = of_action + 2.0 * self._penalty * share * interval * action
            if self._gate is not None:
                of_action = of_action * self._opened[decision]
            if self._largest is not None:
                size = numpy.sqrt((of_action * of_action).sum(axis=0)) / (share * interval)
                of_action *= self._largest / numpy.maximum(size, self._largest)
            rollout.shown_adjoint[:, :count] = policy.backward(decision, of_action)
            rollout.shown_adjoint[self._means.columns] /= interval
        policy.add_gradients(decisions)
        rollout.drop_stored()
        return -reward * share

    def _through_gate(self, decision: int, action: numpy.ndarray) -> numpy.ndarray:
        """Return actions ``(A, N)`` with the fallback's where the gate is closed, and store the mask."""
        chosen, opened, self._gate_memory = self._gate.choose(
            self._observation.T, action.T, self._gate_memory, self._start
        )
        self._start = numpy.zeros_like(self._start)
        self._opened[decision] = opened
        return chosen.T
