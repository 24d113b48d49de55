"""The model of an environment: a task with a filter in the loop.

The engine, the Gymnasium classes and every evaluation step a :class:`Model`. Its methods are the clock of the task,
see :mod:`.task`; :class:`~.compiled.CompiledModel` runs the same ones as compiled code.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters.angles import unwrap
from .causes import Causes, Moment, cause_number
from .companions import LoopRecords, PictureMaker, find_companion, trained_banks
from .draws import Draws
from .filter import Filter, FilterInput
from .observation import Array, Blocks, Field, Reader
from .task import Task, named_arrays


class Episode(NamedTuple):
    """State of N episodes: everything that the engine stores between steps."""

    truth: Any
    """True state; the world's NamedTuple."""
    measurement: Any
    """Readings of the sensors; between ``begin`` and the first measurement the initial estimate."""
    filter: Any
    """State of the filter."""


class Model:
    """A task with a filter in the loop, whose methods step N independent episodes.

    Args:
        task: the estimation problem; compiled models share it with those that are not.
        control: name of the control; the filter is its bank, until :meth:`with_filter` replaces it.

    Attributes:
        filter: the filter in the loop.
        fields: components of the observation.
        action_space: Gymnasium space of the action.
    """

    filter: Any
    fields: tuple[Field, ...]
    action_space: gymnasium.Space[Any]

    def __init__(self, task: Task, control: str) -> None:
        self.task = task
        self.control = control
        self._take_filter({**task.banks, **trained_banks(task)}[control](task, control))

    def _take_filter(self, filter: Filter[Any, Any, Any]) -> None:
        self.filter = filter
        self._blocks = Blocks(filter.blocks, filter.quantities, self.task.xp)
        self.fields = self._blocks.fields
        self.observation_limits: numpy.ndarray = self._blocks.limits
        self.action_space = filter.action_space

    def __deepcopy__(self, memo: dict[int, Any]) -> "Model":
        return self

    def __reduce__(self) -> Any:
        return type(self), (self.task, self.control)

    @property
    def backend(self) -> str:
        """Name of the backend that computes its steps: "numpy", "torch", or "compiled"."""
        return "torch" if "torch" in self.task.xp.__name__ else "numpy"

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the positions of fields in the observation, by their names.

        Raises:
            ValueError: for a name that is no field.
        """
        return self._blocks.columns(names)

    def reader(self, name: str) -> Reader:
        """Return a function that computes a named block or quantity, uncompressed, from observations.

        Raises:
            ValueError: for a name that is neither.
        """
        return self._blocks.reader(name)

    def with_control(self, control: str) -> "Model":
        """Return a model of the same task with the bank of another control."""
        return type(self)(self.task, control)

    def on_numpy(self) -> "Model":
        """Return a model of the same task on NumPy arrays, not compiled."""
        return Model(self.task if self.task.xp is numpy else self.task.on(numpy), self.control)

    def with_filter(self, make: Callable[["Model"], Filter[Any, Any, Any]]) -> "Model":
        """Return a model of the same task with another filter in place of the bank.

        Pass the same function each time: compiled code is stored by it.
        """
        other = copy.copy(self)
        other._take_filter(make(self))
        return other

    def run(self, function: Callable[..., Any], *parts: Any) -> Any:
        """Return ``function(model, *parts)``, computed on this model's backend.

        Args:
            function: of model and arrays; pass the same one each time, since it may be compiled once.
            *parts: nested tuples of arrays ``(..., N)``.
        """
        return function(self, *parts)

    def picture(self) -> Any:
        """Return the object that draws an episode of this task; None where the general picture serves."""
        maker = find_companion(self.task, PictureMaker)
        return None if maker is None or self.task.recording is not None else maker.make(self)

    def truth_for_filter(self, truth: Any) -> Any:
        """Return the truth for a reference, a filter that ``knows`` a part of it; None for any other filter."""
        return truth if self.filter.knows else None

    # --- the filter's part of a step

    def start_filter(self, initial: Any, truth: Any = None) -> Any:
        """Return the filter's state at the start of the track, from the initial estimate."""
        return self.filter.initialise(FilterInput(initial, truth))

    def predict_filter(self, state: Any, measurement: Any) -> Any:
        """Return the filter's state predicted to a measurement, before the update."""
        return self.filter.predict(state, measurement)

    def update_filter(self, state: Any, measurement: Any, action: Array, truth: Any = None) -> Any:
        """Return the filter's state after the update with a measurement; a bank uses the action."""
        return self.filter.update(state, FilterInput(measurement, truth, action))

    def feedback(self, state: Any, measurement: Any) -> Any:
        """Return the feedback of a filter's estimate to the world; None in an open loop."""
        if not self.task.closes_loop:
            return None
        own = self.filter.feedback(state, measurement)
        if own is not None:
            return own
        return self.task.feedback(self.filter.mean(state), self.filter.covariance(state), measurement)

    # --- called by the engine

    def begin(self, uniforms: Array, normals: Array) -> Episode:
        """Return N episodes at the start of the track, made from random numbers.

        Args:
            uniforms: ``(noise.uniforms, N)``.
            normals: ``(noise.initial_normals, N)``.
        """
        truth, initial = self.task.world.begin(Draws(uniforms, self.task.xp), normals)
        return Episode(truth, initial, self.start_filter(initial, self.truth_for_filter(truth)))

    def measure(self, episode: Episode, noise: Array) -> Episode:
        """Return the episodes at the next measurement, with the filter predicted to it (steps 1 and 2 of the clock).

        Args:
            episode: after :meth:`begin` or :meth:`act`.
            noise: random numbers of the measurement, ``(noise.normals + noise.row_uniforms, N)``.
        """
        feedback = self.feedback(episode.filter, episode.measurement)
        truth, measurement = self.task.world.advance(episode.truth, noise, feedback)
        return Episode(truth, measurement, self.predict_filter(episode.filter, measurement))

    def observe(self, episode: Episode) -> Array:
        """Return the agent's observation, ``(len(fields), N)`` (step 3 of the clock)."""
        if not self.fields:  # nothing steers the filter
            N = next(named_arrays(episode.measurement))[1].shape[-1]
            return self.task.xp.zeros((0, N), dtype=self.task.xp.float64, device=self.task.device)
        return self._blocks.observe(episode.filter, episode.measurement)

    def act(self, episode: Episode, action: Array) -> Episode:
        """Return the episodes after the filter's update with the measurement; a bank uses the action (step 4)."""
        truth = self.truth_for_filter(episode.truth)
        return episode._replace(filter=self.update_filter(episode.filter, episode.measurement, action, truth))

    def mean(self, episode: Episode) -> Array:
        """Return the mean of the filter's estimate, ``(len(components), N)``, in the units of ``components``."""
        return self.filter.mean(episode.filter)

    def context(self, episode: Episode) -> dict[str, Array]:
        """Return the episode's random draws and their current values by name, floats ``(..., N)``."""
        context = self.task.world.context(episode.truth)
        return {name: self.task.xp.astype(values, self.task.xp.float64) for name, values in context.items()}

    def moment(self, episode: Episode) -> Moment:
        """Return the :class:`Moment` of the episodes, from which causes of cost are computed."""
        world, measurement = self.task.world, episode.measurement
        return Moment(
            self.task.xp,
            self.context(episode),
            world.state(episode.truth),
            measurement,
            world.component_readings(measurement),
            world.component_deviations(measurement),
        )

    def causes(self, episode: Episode) -> Array:
        """Return the causes of cost at the measurement as one number ``(N,)``, see :func:`.causes.cause_number`."""
        return cause_number(Causes.of(self.task).causes, self.moment(episode))

    def cost(self, episode: Episode) -> Array:
        """Return the uncapped cost of the estimate, ``(N,)`` (step 5 of the clock)."""
        return self.task.world.cost(episode.truth, self.filter.mean(episode.filter))

    def counted_cost(self, episode: Episode) -> Array:
        """Return the part of the estimate's cost that enters the reward, ``(N,)``."""
        return self.task.world.counted_cost(episode.truth, self.filter.mean(episode.filter))

    def error(self, episode: Episode) -> Array:
        """Return the estimate minus the truth, ``(len(components), N)``, in the units of ``components``."""
        return self.task.subtract(self.filter.mean(episode.filter), self.task.world.state(episode.truth))

    def covariance(self, episode: Episode) -> Array:
        """Return the covariance that the filter reports for its estimate, ``(C, C, N)``."""
        return self.filter.covariance(episode.filter)

    def track(self, episode: Episode) -> dict[str, Array]:
        """Return ``truth`` if known, ``estimate``, ``covariance`` and the arrays ``measurement_NAME``, by name."""
        measured = {f"measurement_{name}": values for name, values in named_arrays(episode.measurement)}
        return {**self._truth_and_estimate(episode), **measured}

    def picture_track(self, episode: Episode) -> dict[str, Array]:
        """Return arrays for a picture by name: ``truth`` if known, ``estimate``, ``covariance``, ``seen`` readings."""
        seen = self.task.world.component_readings(episode.measurement)
        return {**self._truth_and_estimate(episode), **({} if seen is None else {"seen": seen})}

    def _truth_and_estimate(self, episode: Episode) -> dict[str, Array]:
        estimate = {"estimate": self.mean(episode), "covariance": self.covariance(episode)}
        if not self.task.has_truth:
            return estimate
        truth = self.task.world.state(episode.truth)
        if self.task.periods:  # angles are drawn on the turn of the truth
            estimate["estimate"] = unwrap(estimate["estimate"], truth, self.task.periods)
        return {"truth": truth, **estimate}

    def records(self, episode: Episode) -> dict[str, Array]:
        """Return further values of filter and world to record at a measurement, by name."""
        records = {
            **self.filter.records(episode.filter, episode.measurement),
            **self.task.world.records(episode.truth),
        }
        further = find_companion(self.task, LoopRecords)
        return records if further is None else {**records, **further.report(self, episode, records)}
