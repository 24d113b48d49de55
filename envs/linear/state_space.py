r"""A task made from a user's state-space model: its world and its class.

    x(k) = f(x(k-1)) + w,  w ~ N(0, Q)          z(k) = h(x(k)) + v,  v ~ N(0, R)          x(0) ~ N(mean, covariance)

A timed model depends on the interval since the previous measurement, and may have known inputs, drawn with the
episode, that acted in it (:mod:`.equations`, :mod:`.inputs`). A measurement then contains both.

The world has one model, or switches between several as a Markov chain from measurement to measurement. The filters may
use other models. The functions are traced once, and differentiated exactly (:mod:`..compiler.vector_functions`).
"""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy

from ...compiler.vector_functions import VectorFunction
from ...extensions import MODEL_COMPANIONS, load_present
from ...filters.small_matrices import apply
from ...filters.smoothing import semidefinite_root
from ..contract.causes import MISSED, OUTLIER, Causes
from ..contract.companions import Actions, ArrayMeanings, LostTracks, TrainedBanks
from ..contract.draws import Draws, category, draw_between
from ..contract.filter import Initial
from ..contract.live_input import LiveReader
from ..contract.observation import Array
from ..contract.task import Component, PaperPolicy, Reward, Scenario
from ..contract.world import World
from .equations import (
    Equations,
    Passage,
    StateSpaceDefinition,
    StateSpaceMeasurement,
    StateSpaceProblem,
    nominal_sensor_noise,
)
from .inputs import InputProcesses
from .live import StateSpaceInput
from .parameters import StateSpaceParameters
from .sensors import Receptions, SensorStates, missing_value_causes
from .state_space_banks import StateSpaceKalmanNetBank, bank_tables


class StateSpaceTruth(NamedTuple):
    """True state of a state-space world, such as current model, noise factors and inputs."""

    state: Array
    """True state, ``(n, N)``."""
    hypothesis: Array
    """Index of the model that holds since the previous measurement, ``(N,)``."""
    process_noise: Array
    """Ratio of the true Q to the model's, ``(N,)``."""
    measurement_noise: Array
    """Ratio of the true R to the model's, ``(N,)``."""
    inputs: Array | None = None
    """Inputs that acted since the previous measurement, ``(p, N)``; None where the model has none."""
    sensors: SensorStates | None = None
    """State of the sensors; None where they have none."""
    waiting: Array | None = None
    """Delayed values and their availability, the oldest first, ``(lateness, 2, m, N)``; None in a task without
    delays."""


class StateSpaceWorld(World[StateSpaceProblem, StateSpaceTruth, StateSpaceMeasurement]):
    """World of a state that moves by one state-space model, or switches between several."""

    parameters: StateSpaceParameters
    received_field: ClassVar[str] = "values"
    cost_remedy: ClassVar[str] = ", give state_space weights= of zero for them"

    def __init__(self, task: StateSpaceProblem) -> None:
        super().__init__(task)
        own = task.definition
        self.equations: list[Equations] = [Equations(task, model) for model in own.world]
        self.sensor_roots: list[Array] = [self._root(model.R) for model in own.world]
        self.process_roots: list[Array] = [self._root(model.Q) for model in own.world]
        self.input_processes: InputProcesses = InputProcesses(tuple(own.inputs.values()), task.xp)
        self.timed: bool = own.world[0].timed
        self.has_jitter: bool = self.parameters.jitter > 0.0
        if self.has_jitter and not self.timed:
            raise ValueError(
                f"the model of {task.id} is not timed, so jitter must be 0, got {self.parameters.jitter}: "
                "write f(x, dt) and Q(dt)"
            )
        self.initial_root: Array = task.constant(semidefinite_root(own.covariance[..., None])[..., 0])
        first = own.world[0]
        n, m = len(own.mean), first.h.size
        self.states: int = n
        self.noises: int = n + m
        self.initial_normals: int = n + self.input_processes.initial_normals
        self.normals: int = self.noises + self.input_processes.normals
        self.is_switching: bool = own.switching and len(own.world) > 1
        self.has_losses: bool = self.parameters.availability < 1.0
        self.drawn: int = int(self.is_switching) + int(self.has_jitter) + int(self.has_losses)
        usual = nominal_sensor_noise(first, own.mean, self.parameters.sampling_interval, own.inputs)
        deviations = numpy.sqrt(numpy.diag(usual))
        self.receptions: Receptions = Receptions(task.parameters, task.xp, own.channels, deviations)
        self.delayed: int = self.drawn + self.receptions.row_uniforms
        self.has_delays: bool = self.parameters.late > 0.0
        self.row_uniforms: int = self.delayed + len(own.channels) * self.has_delays
        turning = {j for one in own.channels if one.period for j in one.numbers}
        # A wrapped angle is no reading of a component, which may exceed a turn.
        self.places: list[int | None] = [None if j in turning else j for j in measurement_indices(first.h)]

    def _root(self, covariance: numpy.ndarray | VectorFunction) -> Array | None:
        if isinstance(covariance, VectorFunction):
            return None
        return self.task.constant(semidefinite_root(covariance[..., None])[..., 0])

    def begin(self, draws: Draws, normals: Array) -> tuple[StateSpaceTruth, Initial]:
        """Draw initial state and noise factors; return this truth and the initial estimate."""
        p, zero, own = self.parameters, 0.0 * normals[0], self.task.definition
        process, measurement = (
            draw_between(draws.log_uniform, name, limits) + zero
            for name, limits in (
                ("process noise", p.process_noise),
                ("measurement noise", p.measurement_noise),
            )
        )
        count = len(own.world)
        first = draws.integer("hypothesis", (0, count - 1)) if self.is_switching else zero
        mean = self.task.constant(own.mean)[:, None] + zero
        covariance = self.task.constant(own.covariance)[:, :, None] + zero
        state = mean + apply(self.initial_root[:, :, None], normals[: self.states])
        inputs = self.input_processes.begin(normals[self.states :])
        sensors, waiting = self.receptions.begin(draws, zero), None
        if self.has_delays:
            nothing = self.xp.stack([self.xp.stack([zero] * (self.noises - self.states))] * 2)
            waiting = self.xp.stack([nothing] * self.parameters.lateness)
        truth = StateSpaceTruth(state, first, process, measurement, inputs, sensors, waiting)
        return truth, Initial(mean, covariance)

    def advance(
        self, truth: StateSpaceTruth, noise: Array, feedback: Any
    ) -> tuple[StateSpaceTruth, StateSpaceMeasurement]:
        """Return the truth at the next measurement, possibly under another model, and that measurement."""
        xp, n = self.xp, self.states
        uniforms = noise[self.normals :]
        hypothesis = truth.hypothesis
        if self.is_switching:
            hypothesis = self._switch(hypothesis, uniforms[0])
        interval = self._interval(truth, uniforms[int(self.is_switching)] if self.has_jitter else None)
        process = xp.sqrt(truth.process_noise) * noise[:n]
        sensors = xp.sqrt(truth.measurement_noise) * noise[n : self.noises]
        inputs, reported = self._inputs(truth, interval, noise[self.noises : self.normals])
        passed = Passage(interval, inputs)
        moved, measured = [], []
        for equations, q, r in zip(self.equations, self.process_roots, self.sensor_roots, strict=True):
            state = equations.move(truth.state, passed)
            root = semidefinite_root(equations.process_noise(state, passed)) if q is None else q[:, :, None]
            state = state + apply(root, process)
            moved.append(state)
            root = semidefinite_root(equations.sensor_noise(state, passed)) if r is None else r[:, :, None]
            measured.append(equations.measure(state, passed) + apply(root, sensors))
        state, values = (self._select(parts, hypothesis) for parts in (moved, measured))
        here = None
        if self.has_losses:
            here = xp.where(uniforms[self.drawn - 1] < self.parameters.availability, 1.0, 0.0)
        sensors, due = self.receptions.advance(
            truth.sensors, self._seconds(truth, interval), uniforms[self.drawn :]
        )
        truth = truth._replace(state=state, hypothesis=hypothesis, inputs=inputs, sensors=sensors)
        received = StateSpaceMeasurement(*self._receive(truth, values, (here, due)), interval, reported)
        return (
            self._delay(truth, received, uniforms[self.delayed :]) if self.has_delays else (truth, received)
        )

    def _delay(
        self, truth: StateSpaceTruth, received: StateSpaceMeasurement, uniforms: Array
    ) -> tuple[StateSpaceTruth, StateSpaceMeasurement]:
        """Return truth and measurement after delays: some values are held back, earlier delayed ones arrive."""
        xp, rows = self.xp, []
        for place, channel in enumerate(self.task.definition.channels):
            rows += [xp.where(uniforms[place] < self.parameters.late, 1.0, 0.0)] * channel.size
        delayed, waiting = xp.stack(rows), truth.waiting
        assert waiting is not None
        later = xp.stack([delayed * received.values, delayed * received.available])
        truth = truth._replace(waiting=xp.concat([waiting[1:], later[None]]))
        in_time = (1.0 - delayed) * received.values, (1.0 - delayed) * received.available
        return truth, StateSpaceMeasurement(*in_time, received.interval, received.inputs, *waiting[0])

    def _receive(
        self, truth: StateSpaceTruth, values: Array, here: Sequence[Array | None]
    ) -> tuple[Array, Array]:
        """Return the received values of all sensors, with offset and wrapped angles, and their availability.

        Both are ``(m, N)``, values zero where not received. ``here`` are masks of 1 where values are received,
        ``(N,)`` or ``(m, N)`` each.
        """
        available = 1.0 + 0.0 * values
        if truth.sensors is not None and truth.sensors.bias is not None:
            values = values + truth.sensors.bias
        if self.equations[0].periods:
            values = self.equations[0].subtract(values, 0.0 * values)
        for part in here:
            if part is not None:
                available = available * part
                values = self.xp.where(part > 0.0, values, 0.0)
        return values, available

    def _seconds(self, truth: StateSpaceTruth, interval: Array | None) -> Array:
        usual: Array = self.parameters.sampling_interval + 0.0 * truth.process_noise
        return usual if interval is None else interval

    def _inputs(
        self, truth: StateSpaceTruth, interval: Array | None, normals: Array
    ) -> tuple[Array | None, Array | None]:
        if truth.inputs is None:
            return None, None
        inputs = self.input_processes.advance(truth.inputs, self._seconds(truth, interval), normals)
        return inputs, self.input_processes.report(inputs, normals)

    def _interval(self, truth: StateSpaceTruth, uniform: Array | None) -> Array | None:
        """Draw the time until the next measurement, s, ``(N,)``; None if the model is not timed."""
        if not self.timed:
            return None
        interval = self.parameters.sampling_interval + 0.0 * truth.process_noise
        return (
            interval if uniform is None else interval * (1.0 + self.parameters.jitter * (2.0 * uniform - 1.0))
        )

    def _select(self, parts: Sequence[Array], hypothesis: Array) -> Array:
        chosen = parts[0]
        for number, part in enumerate(parts[1:], 1):
            if self.is_switching:
                chosen = self.xp.where(hypothesis == float(number), part, chosen)
        return chosen

    def _switch(self, hypothesis: Array, uniform: Array) -> Array:
        rows = numpy.cumsum(self.task.definition.transition, axis=1)[:, :-1]
        thresholds = [
            self._select([0.0 * uniform + value for value in column], hypothesis)
            for column in rows.T.tolist()
        ]
        return self.xp.astype(category(uniform, thresholds, self.xp), self.xp.float64)

    def error_cost(self, error: Array) -> Array:
        """Return the weighted sum of squared errors, ``(N,)``; a component with weight zero need not be known."""
        weights = self.task.definition.weights.tolist()
        terms = [weight * error[i] ** 2 for i, weight in enumerate(weights) if weight]
        return sum(terms[1:], terms[0])

    def reading_deviations(self, measurement: StateSpaceMeasurement) -> Array:
        """Return the standard deviations by the filters' R, ``(m, N)``; at the initial mean if R depends on x."""
        values = measurement.values
        mean = self.task.constant(self.task.definition.mean)
        x = self.xp.stack([mean[i] + 0.0 * values[0] for i in range(self.states)])
        R = self.task.filter_equations[0].sensor_noise(x, measurement)
        return self.xp.stack([self.xp.sqrt(R[j, j]) + 0.0 * values[j] for j in range(values.shape[0])])

    def component_readings(self, measurement: StateSpaceMeasurement) -> Array | None:
        """Return the readings of directly measured components, ``(n, N)``; None where there are none."""
        return self._of_components(measurement.values, measurement.available)

    def component_deviations(self, measurement: StateSpaceMeasurement) -> Array | None:
        """Return the standard deviations of :meth:`component_readings`, ``(n, N)``, by the filters' model."""
        return self._of_components(self.reading_deviations(measurement), measurement.available)

    def _of_components(self, values: Array, available: Array) -> Array | None:
        if all(place is None for place in self.places):
            return None
        xp = self.xp
        none = numpy.nan + 0.0 * values[0]
        return xp.stack(
            [none if j is None else xp.where(available[j] > 0.0, values[j], none) for j in self.places]
        )

    def context(self, truth: StateSpaceTruth) -> dict[str, Array]:
        """Return the index of the current model and the noise factors on Q and R, by name."""
        return {
            "hypothesis": truth.hypothesis,
            "process_noise": truth.process_noise,
            "measurement_noise": truth.measurement_noise,
        }


def measurement_indices(h: VectorFunction) -> list[int | None]:
    """For each component return the index of the number that measures it directly (a unit row of h), or None."""
    if h.matrix is None or numpy.any(h.offset):
        return [None] * (0 if h.matrix is None else h.matrix.shape[1])
    rows = h.matrix.tolist()
    units = numpy.eye(h.matrix.shape[1]).tolist()
    return [rows.index(unit) if unit in rows else None for unit in units]


class StateSpace(StateSpaceProblem):
    """A user's state-space model, and the filters that estimate its state.

    ## Description

    The state moves by a function f and noise of covariance Q; sensors measure a function h of it with noise of
    covariance R. Filters start with the same mean and covariance. They know the model, or use another one where the
    author gives one. Kalman filters are extended ones where f or h is not linear; their Jacobians are exact.

    ## Action Space

    ``Actions`` describes each control; zero is the filter as written.

    ## Observation Space

    Normalised innovations and their squares, averages of these, availability, and the last action.

    ## Rewards

    `log(1 + x0) - log(1 + x)`, x the weighted squared error in units of the cost of the filter as written, x0 that
    of the action zero on the same noise.

    ## Starting State

    Drawn with the initial mean and covariance, which every filter is given.

    ## Episode End

    Truncation after `horizon` measurements.

    ## Version History

    * v0: first release
    """

    Parameters = StateSpaceParameters
    World: ClassVar[type[StateSpaceWorld]] = StateSpaceWorld
    reward: ClassVar[Reward] = Reward("weighted squared error of the components", "log-relative")


REACH = {"noise": ("noise_decades",), "gain": ("gain_factor",), "evidence": ("evidence_scale",)}
"""Parameters that set the range of an action, by control."""


def _explain_loss(
    task: StateSpaceProblem, mean: Array, covariance: Array, measurement: StateSpaceMeasurement
) -> str:
    return task.filter_equations[0].explain_loss(mean, covariance, measurement)


def state_space_attributes(
    definition: StateSpaceDefinition,
    components: tuple[Component, ...],
    defaults: dict[str, Any],
) -> dict[str, Any]:
    """Return the class attributes of a task by name, from the definition of its state-space models.

    ``defaults`` are parameters of the training distribution that differ from the defaults of such tasks.
    """
    banks, actions = bank_tables(len(definition.filters))
    control = next(iter(banks))
    count = {"noise": 2, "evidence": len(definition.filters)}[control]
    held_out: dict[str, tuple[str, dict[str, Any]]] = {
        "rough": ("ten times the process noise", {"process_noise": (10.0, 10.0)}),
        "noisy": ("ten times the measurement noise", {"measurement_noise": (10.0, 10.0)}),
        "gaps": ("gaps of ten measurements on average, a third of the time", {"gaps": 0.05}),
        "biased": ("one sensor is off by three standard deviations", {"bias": 3.0}),
        "late": ("a third of the values of the sensors comes three measurements late", {"late": 1.0 / 3.0}),
    }
    if definition.world[0].timed:
        held_out["jitter"] = ("intervals from a tenth to 1.9 times the usual", {"jitter": 0.9})
    several = len(definition.channels) > 1
    return {
        "definition": definition,
        "components": components,
        "banks": banks,
        "companions": (
            Actions(actions, REACH),
            TrainedBanks({"kalman-net": StateSpaceKalmanNetBank}),
            *(make(definition, defaults) for make in load_present(MODEL_COMPANIONS)),
            LiveReader(StateSpaceInput),
            Causes((*(missing_value_causes(definition.channels) if several else (MISSED,)), OUTLIER)),
            LostTracks(explain=_explain_loss),
            ArrayMeanings(measurement=definition.measurement_words),
        ),
        "scenarios": {
            "random": Scenario("random", "The model as it is given.", defaults, training=True),
            **{
                name: Scenario(name, f"Held out: {words}.", {**defaults, **changed})
                for name, (words, changed) in held_out.items()
            },
        },
        "paper_policy": PaperPolicy(control, (0.0,) * count),
    }
