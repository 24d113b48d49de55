"""Training through the filter: a small network learns from the gradient of the episode's cost.

A task is differentiable from the action to the reward of every later measurement. So no value function and no
exploration are needed: the mean cost of a batch of episodes is differentiated through filter and policy
(back-propagation through time) and minimised by Adam. In long episodes the gradient is truncated every ``truncation``
decisions: the states continue, the gradients do not flow further back.

Compiled episodes are differentiated by :mod:`.unrolled`, with torch's gradients and several times as fast; a task that
cannot be compiled runs on torch tensors. The network is a linear rule, has one hidden layer, or a memory (``network``);
a fast one reads only the few fields with the largest weights at the end of its training (``fields_kept``).

A learned estimator (``kalman-net``) is trained in the same way: its network acts on a filter of its own.
"""

import functools
import io
import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy
import torch

from ..envs.contract.model import Model
from ..envs.contract.parameters import ParameterLimits, check, check_integer
from ..envs.engine.catalogue import nearest
from ..envs.engine.reward import LIKELIHOOD_WEIGHTS
from ..envs.engine.rollout import TrainingObjective
from ..envs.engine.scenario_choice import find_mixture
from ..envs.interface.vector_environment import TaskVectorEnv
from ..evaluation.competitors.kinds import Policy
from ..evaluation.running.seeds import episode_seeds
from ..filters.array_namespace import host_array
from .eager_optimiser import exclude_from_compilation, step_eagerly
from .gate import Gate, wrap_as_trained
from .learned_estimator import EstimatorMaker
from .learned_policy import LearnedPolicy, write_arrays
from .settings import ESTIMATORS
from .training_run import TrainingRun, schedule
from .training_session import Bookkeeping, Session, Trainee, curve_writer, interruption, make_logger
from .unrolled import Teacher, Unrolled

NETWORKS = ("linear", "feedforward", "recurrent")
"""A linear rule; one hidden layer; a gated recurrent unit, which has a memory."""
ACTIVATION = "relu"
"""Activation of the hidden layer: sixteen rectifiers take as long as four tanh."""
PRUNED = 0.5
"""Share of a run after which only the kept fields are read."""
NEAREST = 0.9
"""Largest magnitude of the first actions, with the box scaled to -1 to 1: nearer to the edge the gradient vanishes."""


class NetworkPolicy(torch.nn.Module):
    """A network as a policy: normalised observation -> network -> tanh -> box of the actions.

    Args:
        observations: number of fields of the observation.
        space: space of the actions.
        hidden_size: units of the memory or of the hidden layer; unused by a linear rule.
        first_action: approximate action before training; default: the middle of the box.
        network: one of ``NETWORKS``.
        fields_kept: number of fields of the observation that the saved agent reads; None: all.
        longest_memory: initial time constant of the slowest unit of a memory, in decisions; that of the fastest is one.
            None: about two for all units.

    Raises:
        ValueError: for an invalid action, network or memory, or for fewer than one field.
    """

    low: torch.Tensor
    high: torch.Tensor
    mean: torch.Tensor
    scale: torch.Tensor
    used: torch.Tensor
    """1 for a field that is read, 0 for a field that is no longer read."""

    def __init__(
        self,
        observations: int,
        space: gymnasium.spaces.Box,
        hidden_size: int,
        first_action: Sequence[float] | None = None,
        network: str = "recurrent",
        fields_kept: int | None = None,
        longest_memory: float | None = None,
    ) -> None:
        super().__init__()
        if network not in NETWORKS:
            raise nearest("network", network, NETWORKS)
        middle, half = 0.5 * (space.high + space.low), 0.5 * (space.high - space.low)
        first = middle if first_action is None else numpy.asarray(first_action, dtype=float)
        if first.shape != space.shape or not space.contains(first.astype(space.dtype)):
            raise ValueError(f"first_action must be an action of {space}, got {first_action!r}")
        inside = numpy.clip((first - middle) / half, -NEAREST, NEAREST)
        kept = observations if fields_kept is None else check_integer("fields_kept", fields_kept, 1)
        self.fields_kept: int = min(observations, kept)
        self.gru: Any = torch.nn.GRUCell(observations, hidden_size) if network == "recurrent" else None
        hidden = [torch.nn.Linear(observations, hidden_size)] if network == "feedforward" else []
        self.hidden: torch.nn.ModuleList = torch.nn.ModuleList(hidden)
        inputs = observations if network == "linear" else hidden_size
        self.head: torch.nn.Linear = torch.nn.Linear(inputs, space.shape[0])
        with torch.no_grad():
            # Begin away from the edge of the box, with a gradient.
            self.head.weight.mul_(0.1)
            self.head.bias.copy_(torch.as_tensor(numpy.arctanh(inside)))
            if self.gru is not None and longest_memory is not None:
                check("longest_memory", longest_memory, float, ParameterLimits(above=1.0))
                # A unit whose update gate has the logit log T forgets over about T decisions (Tallec and Ollivier,
                # "Can recurrent neural networks warp time?", ICLR 2018).
                update = slice(hidden_size, 2 * hidden_size)
                self.gru.bias_ih[update] = torch.linspace(0.0, math.log(longest_memory), hidden_size)
        self.register_buffer("low", torch.as_tensor(space.low))
        self.register_buffer("high", torch.as_tensor(space.high))
        self.register_buffer("mean", torch.zeros(observations))
        self.register_buffer("scale", torch.ones(observations))
        self.register_buffer("used", torch.ones(observations))

    @property
    def layers(self) -> list[torch.nn.Linear]:
        """Linear layers from input to output, after the memory; tanh follows the last, ReLU the others."""
        return [*cast("Iterable[torch.nn.Linear]", self.hidden), self.head]

    @property
    def memory_size(self) -> int:
        """Number of units of the recurrent memory; 0 without one."""
        return 0 if self.gru is None else self.gru.hidden_size

    def new_memory(self, envs: int) -> torch.Tensor:
        """Return the memory at the start of episodes, zeros ``(envs, memory_size)``."""
        return self.mean.new_zeros(envs, self.memory_size)

    def forward(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions and memory for observations ``(N, fields)`` and memory ``(N, memory_size)``."""
        features = ((observation.to(self.mean.dtype) - self.mean) / self.scale).clamp(-10.0, 10.0) * self.used
        if self.gru is not None:
            features = memory = self.gru(features, memory)
        for layer in self.hidden:
            features = torch.relu(layer(features))
        return self.low + (self.high - self.low) * 0.5 * (1.0 + torch.tanh(self.head(features))), memory

    def strongest_fields(self, count: int) -> numpy.ndarray:
        """Return the ascending indices of the ``count`` fields with the largest weights among those in use.

        Observations are normalised, so that a small weight means a small influence (magnitude pruning).
        """
        first = self.layers[0].weight if self.gru is None else self.gru.weight_ih
        # A field that is not in use comes after all others, whatever its weight once was.
        strength = torch.where(self.used > 0.0, first.detach().norm(dim=0), -1.0).numpy()
        return numpy.sort(numpy.argsort(-strength, kind="stable")[:count])

    def use_fields(self, count: int) -> None:
        """Limit the observation fields in use to the ``count`` fields with the largest weights."""
        self.used[numpy.setdiff1d(numpy.arange(len(self.used)), self.strongest_fields(count))] = 0.0

    def arrays(self) -> dict[str, numpy.ndarray]:
        """Return the network's arrays by their names in an agent's file, of the strongest fields alone."""
        columns = self.strongest_fields(self.fields_kept)
        named = {"observation_mean": self.mean[columns], "observation_scale": self.scale[columns]}
        if self.gru is not None:
            named |= {
                "gru_input_weight": self.gru.weight_ih[:, columns],
                "gru_input_bias": self.gru.bias_ih,
                "gru_memory_weight": self.gru.weight_hh,
                "gru_memory_bias": self.gru.bias_hh,
            }
        for i, layer in enumerate(self.layers):
            of_fields = i == 0 and self.gru is None
            named[f"weight_{i}"] = layer.weight[:, columns] if of_fields else layer.weight
            named[f"bias_{i}"] = layer.bias
        return {name: tensor.detach().numpy().copy() for name, tensor in named.items()}

    def fields(self, model: Model) -> list[str]:
        """Return the names of the observation fields that the agent reads once it is saved."""
        return [model.fields[i].name for i in self.strongest_fields(self.fields_kept)]


def descend_episodes(
    env: TaskVectorEnv,
    policy: NetworkPolicy,
    truncation: int,
    descend: Callable[[], None],
    gate: Gate | None = None,
    largest: float | None = None,
    penalty: float = 0.0,
) -> float:
    """Simulate an episode in every environment, with a gradient step after each window; return the mean cost.

    Args:
        env: environments with torch backend and autoreset mode "Disabled".
        policy: the policy, to whose gradients are added.
        truncation: decisions through which the gradient flows back.
        descend: function that uses and clears the policy's gradients, those of the mean cost of a decision since its
            last call. It is called every ``truncation`` decisions and at the end.
        gate: gate that decides whether the policy acts; other decisions have no gradient.
        largest: norm to which the gradient of a window's costs with respect to one action of an episode is clipped. In
            episodes that lose the track the gradient grows with every decision that it flows back: without clipping,
            few episodes dominate the sum.
        penalty: cost, in the unit of the reward, of an action whose numbers have the sum of squares one. It keeps
            actions near zero, the filter itself, where they gain little.

    Returns:
        Mean cost of a measurement, in the unit of the reward and compressed in the same way.
    """
    observation, _ = env.reset()
    hidden = policy.new_memory(env.num_envs)
    total, pending, penalties = 0.0, torch.zeros(()), torch.zeros(())
    memory, start = None, numpy.ones(env.num_envs, dtype=bool)

    def cut(gradient: torch.Tensor, largest: float) -> torch.Tensor:
        size = gradient.norm(dim=1, keepdim=True) * (window * env.num_envs)
        return gradient * (largest / size.clamp_min(largest))

    for decision in range(1, env.last_decision + 1):
        action, hidden = policy(observation, hidden)
        # In double, so that the filter's state is not rounded to the network's precision.
        action = action.double()
        if gate is not None:
            shown, answer = (host_array(tensor.detach()) for tensor in (observation, action))
            chosen, opened, memory = gate.choose(shown, answer, memory, start)
            start = numpy.zeros(env.num_envs, dtype=bool)
            action = torch.where(torch.as_tensor(opened)[:, None], action, torch.as_tensor(chosen))
        if largest is not None:
            action.register_hook(functools.partial(cut, largest=largest))
        observation, reward, _, _, _ = env.step(action)
        pending = pending - reward.mean()
        penalties = penalties + penalty * action.square().sum(dim=1).mean()
        window = (decision - 1) % truncation + 1
        if window == truncation or decision == env.last_decision:
            ((pending + penalties) / window).backward()
            total += float(pending.detach())
            descend()
            pending, penalties = torch.zeros(()), torch.zeros(())
            hidden, observation = hidden.detach(), observation.detach()
            env.fleet.detach()
    return total / env.last_decision


def measure_normalisation(env: TaskVectorEnv, policy: NetworkPolicy) -> None:
    """Set the input normalisation of a policy to mean and deviation of the observations that its own actions cause."""
    observation, _ = env.reset()
    hidden = policy.new_memory(env.num_envs)
    seen = []
    with torch.no_grad():
        for _ in range(env.last_decision):
            shown = torch.as_tensor(observation)
            seen.append(shown)
            action, hidden = policy(shown, hidden)
            observation = env.step(action.double())[0]
        every = torch.cat(seen)
        policy.mean.copy_(every.mean(0))
        policy.scale.copy_(every.std(0).clamp_min(1e-3))


def _environment(run: TrainingRun) -> TaskVectorEnv:
    """Return the differentiable environments of a run: compiled where possible, else on torch."""
    make = functools.partial(
        TaskVectorEnv,
        run.environment,
        run.envs,
        control=run.control,
        scenario=run.scenario,
        reward=_reward_to_descend(run),
        autoreset_mode="Disabled",
        **run.task_keywords,
    )
    mixture = find_mixture(run.problem.task, run.scenario)
    if mixture is not None:
        if run.backend == "compiled":
            raise ValueError(
                f"algorithm {run.algorithm!r} learns mixtures of scenarios on torch only: leave out the backend"
            )
        models = [run.make_model(name) for name in mixture]
        if len({model.task.horizon for model in models}) > 1:
            raise ValueError(
                f"algorithm {run.algorithm!r} learns from episodes of one length, not from {run.scenario}: "
                "set env.horizon"
            )
    elif run.backend in ("auto", "compiled"):
        env = make(backend=run.backend)
        if env.backend == "compiled":
            return env
    return make(backend="torch")


def _reward_to_descend(run: TrainingRun) -> str:
    """Return the name of the reward to differentiate; ``relative`` has the same gradient as ``cost``."""
    kind = run.hyperparameters.get("env_kwargs", {}).get("reward", "cost")
    return "cost" if kind == "relative" else kind


def _training_objective(run: TrainingRun) -> TrainingObjective:
    """Return the objective of a run: its reward, and the share of a teacher's estimates in it.

    Raises:
        ValueError: if a student cannot be trained with this reward.
    """
    kind, values = _reward_to_descend(run), run.hyperparameters
    if values.get("teacher") is None:
        return TrainingObjective(kind)
    if kind not in LIKELIHOOD_WEIGHTS:
        raise nearest("reward of a student", kind, LIKELIHOOD_WEIGHTS)
    share = values.get("teacher_share", 1.0)
    check("teacher_share", share, float, ParameterLimits(above=0.0, at_most=1.0))
    return TrainingObjective(kind, share)


def _make_agent(policy: NetworkPolicy, gated: bool, model: Model) -> Policy:
    network = LearnedPolicy(model, policy.arrays(), "tanh", ACTIVATION, policy.fields(model))
    return wrap_as_trained(model, network, gated=gated)


class Descent:
    """State of a training run through the filter: network, environments, optimiser and number of steps.

    Args:
        run: the run; its ``backend`` is set to that of the environments.

    Raises:
        ValueError: for a control with discrete actions.
    """

    def __init__(self, run: TrainingRun) -> None:
        space = run.make_model().action_space
        if not isinstance(space, gymnasium.spaces.Box):
            raise ValueError(
                f"algorithm {run.algorithm!r} needs the gradient of continuous actions, but control {run.control!r} "
                f"has {space}: choose dqn or ppo, or another control"
            )
        self.run = run
        self.values: dict[str, Any] = run.hyperparameters
        torch.manual_seed(run.seed)
        self.env: TaskVectorEnv = _environment(run)
        run.backend = self.env.backend
        self.env.reset(seed=episode_seeds("train", run.seed, run.envs))
        values = self.values
        self.policy: NetworkPolicy = NetworkPolicy(
            len(self.env.model.fields),
            space,
            values["hidden_size"],
            values.get("first_action"),
            values.get("network", "recurrent"),
            values.get("fields_kept"),
            values.get("longest_memory"),
        )
        self.learning_rate: Callable[[float], float] = schedule("learning_rate", self.values["learning_rate"])
        exclude_from_compilation()
        self.optimiser: Any = torch.optim.Adam(self.policy.parameters(), lr=self.learning_rate(1.0))
        step_eagerly(self.optimiser)
        self.steps_done: int = 0

    def episode_function(self) -> Callable[[Callable[[], None]], float]:
        """Return a function that simulates episodes, calls its argument at each gradient step, and returns the cost."""
        env, policy, truncation = self.env, self.policy, self.values["truncation"]
        gate, largest = Gate(env.model) if self.run.gated else None, self.values.get("max_action_grad")
        teacher, penalty = self.values.get("teacher"), self.values.get("action_penalty", 0.0)
        check("action_penalty", penalty, float, ParameterLimits(at_least=0.0))
        if env.backend == "compiled":
            reward = _training_objective(self.run)
            beside = None if teacher is None else Teacher(env, teacher)
            return Unrolled(env, policy, truncation, reward, beside, gate, largest, penalty).descend_episodes
        if teacher is not None:
            raise ValueError(
                f"teacher {teacher!r} needs compiled episodes, and these run on torch: leave it out"
            )
        return functools.partial(
            descend_episodes, env, policy, truncation, gate=gate, largest=largest, penalty=penalty
        )

    def update(self) -> float:
        """Clip the accumulated gradient, do an optimiser step, and return the gradient's norm before clipping."""
        norm = torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.values["max_grad_norm"])
        self.optimiser.step()
        self.optimiser.zero_grad()
        return float(norm)

    def follow_schedule(self) -> None:
        """Set the learning rate, and prune observation fields, for the share of the run that is done."""
        done, policy = self.steps_done / self.run.steps, self.policy
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(1.0 - done)
        # Geometrically fewer, so that the network trains about as long after each removal.
        every = len(policy.used)
        policy.use_fields(math.ceil(every * (policy.fields_kept / every) ** min(1.0, done / PRUNED)))

    def trainee(self) -> Trainee:
        """Return the agent as a :class:`Trainee`: its policy, and functions that save checkpoint and agent."""
        run, policy = self.run, self.policy
        agent = functools.partial(_make_agent, policy, run.gated)

        def save_agent(place: Path) -> None:
            path = place / "agent.safetensors"
            write_arrays(path, policy.arrays(), run, "tanh", ACTIVATION, policy.fields(self.env.model))

        steered = EstimatorMaker(run.control, agent) if run.algorithm in ESTIMATORS else agent
        return Trainee(steered, self.save_checkpoint, save_agent)

    def save_checkpoint(self, folder: Path) -> None:
        """Write a checkpoint into a folder: network, optimiser, random generators and number of steps."""
        generators = [generator.bit_generator.state for generator in self.env.fleet.generators]
        kept = {
            "policy": self.policy.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generators": json.dumps(generators),
            "steps": self.steps_done,
        }
        # Through memory: on a full disk torch raises its own exception.
        written = io.BytesIO()
        torch.save(kept, written)
        (folder / "checkpoint.pt").write_bytes(written.getvalue())

    def load_checkpoint(self, folder: Path) -> None:
        """Restore network, optimiser and environments from the checkpoint in a folder.

        Raises:
            ValueError: if it cannot be read.
        """
        try:
            # weights_only: nothing in the file is executed.
            kept = torch.load(folder / "checkpoint.pt", weights_only=True)
            self.policy.load_state_dict(kept["policy"])
            self.optimiser.load_state_dict(kept["optimiser"])
            states = json.loads(kept["generators"])
            for generator, state in zip(self.env.fleet.generators, states, strict=True):
                generator.bit_generator.state = state
            self.steps_done = int(kept["steps"])
        except Exception as error:  # for a corrupt file torch raises various exceptions
            raise ValueError(f"cannot read the checkpoint in {folder}: {error}") from error


def train_bptt(run: TrainingRun, session: Session) -> TrainingRun:
    """Train a network by gradients through the filter up to ``run.steps``, or Ctrl-C or SIGTERM; return the run.

    A control with discrete actions, and a checkpoint that cannot be read, raise ValueError.
    """
    if session.resume and run.is_complete:
        return run
    began = time.monotonic()
    descent = Descent(run)
    if session.resume:
        descent.load_checkpoint(session.folder / "checkpoint")
    else:
        measure_normalisation(descent.env, descent.policy)
    fly = descent.episode_function()
    logger = make_logger(session.folder / "log", descent.steps_done)

    def descend() -> None:
        logger.record_mean("train/gradient_norm", descent.update())

    per_iteration = run.envs * descent.env.last_decision
    with interruption() as stop:
        books = Bookkeeping(run, session, descent.trainee(), stop, curve_writer(logger), began)
        stopping = False
        while descent.steps_done < run.steps and not stopping:
            descent.follow_schedule()
            cost = fly(descend)
            descent.steps_done += per_iteration
            logger.record("train/cost", cost)
            logger.dump(descent.steps_done)
            session.progress(descent.steps_done)
            stopping = books.safe_point(descent.steps_done)
        if not stopping and run.steps_done < descent.steps_done:
            books.safe_point(descent.steps_done, last=True)
    logger.close()
    return run
