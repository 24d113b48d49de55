r"""A task made of a state-space model that somebody gives: what is declared, the world, and the task.

    x(k) = f(x(k-1)) + w,  w ~ N(0, Q)          z(k) = h(x(k)) + v,  v ~ N(0, R)          x(0) ~ N(mean, covariance)

A model may know the time: then f and Q are of the interval dt since the measurement before, ``x(k) = f(x(k-1), dt) +
w``, ``w ~ N(0, Q(dt))``, and a measurement says its interval.

The world obeys one model, or several between which it switches as a Markov chain from measurement to measurement. The
filters may believe others. Functions are traced once, on vectors of symbols, and differentiated exactly
(:mod:`..compiler.vector_functions`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy

from ...compiler.vector_functions import VectorFunction
from ...filters.small_matrices import apply, product, transpose
from ...filters.smoothing import semidefinite_root
from ..contract.causes import MISSED, OUTLIER
from ..contract.draws import Draws, category, draw_between
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.parameters import TaskParameters, parameter
from ..contract.task import Component, PaperPolicy, Scenario, Task
from ..contract.world import World
from .live import StateSpaceInput
from .logs import state_space_log_format


@dataclass(frozen=True, eq=False)
class StateSpaceModel:
    """Equations of a state-space model."""

    f: VectorFunction
    h: VectorFunction
    Q: numpy.ndarray | VectorFunction
    """``(n, n)``; or a function from the interval, s, to the n^2 numbers of it, row by row: then f takes the interval
    after the state, and the model is timed."""
    R: numpy.ndarray
    """``(m, m)``."""

    @property
    def timed(self) -> bool:
        """Whether f and Q are functions of the interval between measurements."""
        return isinstance(self.Q, VectorFunction)

    @property
    def stands_still(self) -> bool:
        """Whether nothing happens in no time, as far as some states show: measurements may then come at one time."""
        if not isinstance(self.Q, VectorFunction):
            return False
        x = numpy.linspace(-1.0, 2.0, 3 * self.f.size).reshape(self.f.size, 3)
        moved = self.f.value(numpy.concatenate([x, numpy.zeros((1, 3))]), numpy)
        return numpy.allclose(moved, x, 1e-12, 1e-12) and not self.process_noise(0.0).any()

    def process_noise(self, interval: float) -> numpy.ndarray:
        """Q of an interval, s, ``(n, n)``; without time the same for all."""
        if not isinstance(self.Q, VectorFunction):
            return self.Q
        return numpy.reshape(self.Q.value(numpy.array([[interval]]), numpy), (self.f.size, self.f.size))

    @property
    def is_linear(self) -> bool:
        """Whether both functions are matrices."""
        maps = (self.f, self.h)
        return all(one.matrix is not None and not numpy.any(one.offset) for one in maps)


@dataclass(frozen=True, eq=False)
class StateSpaceDefinition:
    """All that makes a task of state-space models."""

    world: tuple[StateSpaceModel, ...]
    """Models that the world obeys, M of them."""
    filters: tuple[StateSpaceModel, ...]
    """What the filters believe of each."""
    transition: tuple[tuple[float, ...], ...]
    """Probabilities that one model follows another from a measurement to the next (row = from), ``(M, M)``."""
    switching: bool
    """Whether the world does so; else it obeys the first model."""
    mean: numpy.ndarray
    """``(n,)``."""
    covariance: numpy.ndarray
    """``(n, n)``."""
    weights: numpy.ndarray
    """Of the squared error of each component in the cost, ``(n,)``."""


@dataclass(frozen=True)
class StateSpaceParameters(TaskParameters):
    """Parameters of every task of state-space models."""

    sampling_interval: float = parameter(1.0, above=0.0)
    """Time between measurements, s; of a timed model on average."""
    jitter: float = parameter(0.0, at_least=0.0, below=1.0)
    """Share of the sampling interval by which the interval before a measurement differs at most, of a timed model."""
    process_noise: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """Limits of the factor by which the true Q differs from the model's, drawn log-uniformly for every episode."""
    measurement_noise: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """Likewise of R."""
    availability: float = parameter(1.0, at_least=0.0, at_most=1.0)
    """Probability that a measurement is received."""
    noise_decades: float = parameter(2.0, above=0.0)
    """Decades by which an action of one scales Q or R (control ``noise``)."""
    gain_factor: float = parameter(4.0, above=1.0)
    """Factor by which an action of one multiplies the gain of a component (control ``gain``)."""
    evidence_scale: float = parameter(2.0, above=0.0)
    """Nats that an evidence of one adds to the log-posterior (control ``evidence``)."""


class Truth(NamedTuple):
    """What is."""

    state: Array
    """``(n, N)``."""
    hypothesis: Array
    """Number of the model that led here, ``(N,)``."""
    process_noise: Array
    """True Q over the model's, ``(N,)``."""
    measurement_noise: Array
    """True R over the model's, ``(N,)``."""


class Measurement(NamedTuple):
    """What the sensors say."""

    values: Array
    """``(m, N)``; zero where nothing was received, where an estimator gets NaN."""
    available: Array
    """1 where a value was received, 0 where not, ``(m, N)``."""
    interval: Array | None = None
    """Since the measurement before, or the start, s, ``(N,)``; None where the model is not timed."""


class Equations:
    """A model on the arrays of a task.

    Args:
        task: whose arrays they are.
        model: the equations.
    """

    def __init__(self, task: Task, model: StateSpaceModel) -> None:
        self.model, self.xp = model, task.xp
        self.R = task.constant(model.R)
        self._Q = None if model.timed else task.constant(model.Q)
        self._F, self._H = (
            None if one.matrix is None else task.constant(one.matrix) for one in (model.f, model.h)
        )

    def move(self, x: Array, interval: Array | None) -> Array:
        """State without noise at the next measurement, ``(n, ...)``.

        Args:
            x: ``(n, ...)``.
            interval: until then, s, ``(N,)``; None where the model is not timed.
        """
        if interval is None:
            return self._value(self.model.f, x)
        return self._value(self.model.f, self._with_interval(x, interval))

    def _with_interval(self, x: Array, interval: Array) -> Array:
        """State with the interval as its last row, ``(n + 1, ...)``."""
        return self.xp.concat([x, (0.0 * x[0] + interval)[None]])

    def process_noise(self, interval: Array | None) -> Array:
        """Q of an interval, ``(n, n, N)``, without time ``(n, n, 1)``."""
        if self._Q is not None:
            return self._Q[:, :, None]
        assert isinstance(self.model.Q, VectorFunction)
        assert interval is not None
        n = self.model.f.size
        return self.xp.reshape(self.model.Q.value(interval[None], self.xp), (n, n, *interval.shape))

    def measure(self, x: Array) -> Array:
        """Measurement without noise, ``(m, ...)``."""
        return self._value(self.model.h, x)

    def _value(self, function: VectorFunction, x: Array) -> Array:
        flat = self.xp.reshape(x, (x.shape[0], -1))
        return self.xp.reshape(function.value(flat, self.xp), (function.size, *x.shape[1:]))

    def transition_matrix(self, x: Array, interval: Array | None) -> Array:
        """Jacobian of f, ``(n, n, N)``; the last axis is 1 where it is the same everywhere."""
        if interval is not None:
            return self.model.f.jacobian(self._with_interval(x, interval), self.xp)
        return self.model.f.jacobian(x, self.xp) if self._F is None else self._F[:, :, None]

    def measurement_matrix(self, x: Array) -> Array:
        """Jacobian of h, likewise."""
        return self.model.h.jacobian(x, self.xp) if self._H is None else self._H[:, :, None]

    def carry(self, mean: Array, covariance: Array, interval: Array | None) -> tuple[Array, Array]:
        """Mean and covariance at the next measurement, without process noise; ``interval`` as of :meth:`move`."""
        F = self.transition_matrix(mean, interval)
        return self.move(mean, interval), product(product(F, covariance), transpose(F))


class StateSpaceWorld(World["StateSpace", Truth, Measurement]):
    """A state that moves by one model, or switches between several."""

    parameters: StateSpaceParameters
    received_field: ClassVar[str] = "values"

    def __init__(self, task: "StateSpace") -> None:
        super().__init__(task)
        own = task.definition
        self.equations = [Equations(task, model) for model in own.world]
        self.sensor_roots = [self._root(model.R) for model in own.world]
        self.process_roots = [
            None if isinstance(model.Q, VectorFunction) else self._root(model.Q) for model in own.world
        ]
        self.timed, self.jitters = own.world[0].timed, self.parameters.jitter > 0.0
        if self.jitters and not self.timed:
            raise ValueError(
                f"{task.id} knows no time, so jitter must be 0, got {self.parameters.jitter}: write f(x, dt) and Q(dt)"
            )
        self.initial_root = task.constant(semidefinite_root(own.covariance[..., None])[..., 0])
        n, m = len(own.mean), own.world[0].h.size
        self.initial_normals, self.normals = n, n + m
        self.switches = own.switching and len(own.world) > 1
        self.loses = self.parameters.availability < 1.0
        self.row_uniforms = int(self.switches) + int(self.jitters) + int(self.loses)
        self.places = _components_measured(own.world[0].h)

    def _root(self, covariance: numpy.ndarray) -> Array:
        return self.task.constant(semidefinite_root(covariance[..., None])[..., 0])

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw the start and the noise of the episode; everyone starts with the same mean and covariance."""
        p, zero, own = self.parameters, 0.0 * normals[0], self.task.definition
        factors = [
            draw_between(draws.log_uniform, name, limits) + zero
            for name, limits in (
                ("process noise", p.process_noise),
                ("measurement noise", p.measurement_noise),
            )
        ]
        count = len(own.world)
        first = draws.integer("hypothesis", (0, count - 1)) if self.switches else zero
        mean = self.task.constant(own.mean)[:, None] + 0.0 * normals
        covariance = self.task.constant(own.covariance)[:, :, None] + zero
        state = mean + apply(self.initial_root[:, :, None], normals)
        return Truth(state, first, *factors), Initial(mean, covariance)

    def advance(self, truth: Truth, noise: Array, feedback: Any) -> tuple[Truth, Measurement]:
        """Switch, move, measure."""
        xp, n = self.xp, self.initial_normals
        uniforms = noise[self.normals :]
        hypothesis = truth.hypothesis
        if self.switches:
            hypothesis = self._switch(hypothesis, uniforms[0])
        interval = self._interval(truth, uniforms[int(self.switches)] if self.jitters else None)
        process = xp.sqrt(truth.process_noise) * noise[:n]
        sensors = xp.sqrt(truth.measurement_noise) * noise[n : self.normals]
        moved, measured = [], []
        for equations, q, r in zip(self.equations, self.process_roots, self.sensor_roots, strict=True):
            root = semidefinite_root(equations.process_noise(interval)) if q is None else q[:, :, None]
            state = equations.move(truth.state, interval) + apply(root, process)
            moved.append(state)
            measured.append(equations.measure(state) + apply(r[:, :, None], sensors))
        state, values = (self._chosen(parts, hypothesis) for parts in (moved, measured))
        available = 1.0 + 0.0 * values
        if self.loses:
            here = xp.where(uniforms[-1] < self.parameters.availability, 1.0, 0.0)
            available = available * here
            values = xp.where(here > 0.0, values, 0.0)
        return truth._replace(state=state, hypothesis=hypothesis), Measurement(values, available, interval)

    def _interval(self, truth: Truth, uniform: Array | None) -> Array | None:
        """Time that passes until the next measurement, s, ``(N,)``; None where the model is not timed."""
        if not self.timed:
            return None
        interval = self.parameters.sampling_interval + 0.0 * truth.process_noise
        return (
            interval if uniform is None else interval * (1.0 + self.parameters.jitter * (2.0 * uniform - 1.0))
        )

    def _chosen(self, parts: Sequence[Array], hypothesis: Array) -> Array:
        """Of the arrays of all models that of the one in force."""
        chosen = parts[0]
        for number, part in enumerate(parts[1:], 1):
            if self.switches:
                chosen = self.xp.where(hypothesis == float(number), part, chosen)
        return chosen

    def _switch(self, hypothesis: Array, uniform: Array) -> Array:
        """Number of the model that follows, ``(N,)``."""
        rows = numpy.cumsum(self.task.definition.transition, axis=1)[:, :-1]
        thresholds = [
            self._chosen([0.0 * uniform + value for value in column], hypothesis)
            for column in rows.T.tolist()
        ]
        return self.xp.astype(category(uniform, thresholds, self.xp), self.xp.float64)

    def error_cost(self, error: Array) -> Array:
        """Weighted sum of squared errors; a component without weight need not be known."""
        weights = self.task.definition.weights.tolist()
        terms = [weight * error[i] ** 2 for i, weight in enumerate(weights) if weight]
        return sum(terms[1:], terms[0])

    def reading_deviations(self, measurement: Measurement) -> Array:
        """Those of the R that the filters believe."""
        sigma = self.task.constant(numpy.sqrt(numpy.diag(self.task.definition.filters[0].R)))
        return sigma[:, None] + 0.0 * measurement.values

    def component_readings(self, measurement: Measurement) -> Array | None:
        """Readings of components that are measured as they are; None where none is."""
        return self._of_components(measurement.values, measurement.available)

    def component_deviations(self, measurement: Measurement) -> Array | None:
        """Deviations that the model states for them."""
        return self._of_components(self.reading_deviations(measurement), measurement.available)

    def _of_components(self, values: Array, available: Array) -> Array | None:
        if all(place is None for place in self.places):
            return None
        xp = self.xp
        none = numpy.nan + 0.0 * values[0]
        return xp.stack(
            [none if j is None else xp.where(available[j] > 0.0, values[j], none) for j in self.places]
        )

    def context(self, truth: Truth) -> dict[str, Array]:
        """The model in force and the factors on Q and R."""
        return {
            "hypothesis": truth.hypothesis,
            "process_noise": truth.process_noise,
            "measurement_noise": truth.measurement_noise,
        }


def _components_measured(h: VectorFunction) -> list[int | None]:
    """Of each component the place of its measurement, where h hands it on as it is."""
    if h.matrix is None or numpy.any(h.offset):
        return [None] * (0 if h.matrix is None else h.matrix.shape[1])
    rows = h.matrix.tolist()
    units = numpy.eye(h.matrix.shape[1]).tolist()
    return [rows.index(unit) if unit in rows else None for unit in units]


class StateSpace(Task):
    """A state-space model of your own, and the filters that estimate its state.

    ## Description

    The state moves by a function f and noise of covariance Q; sensors measure a function h of it with noise of
    covariance R. Filters start with the same mean and covariance. They know the model, or believe another one where the
    author says so. Kalman filters are extended ones where f or h is not linear; their Jacobians are exact.

    ## Action Space

    What each control means stands in ``actions``; zero is the filter as written.

    ## Observation Space

    Normalised innovations and their squares, averages of these, what was received, and the last action.

    ## Rewards

    `log(1 + x0) - log(1 + x)`, x the weighted squared error in units of what the filter as written is charged, x0 that
    of the action zero on the same noise.

    ## Starting State

    Drawn with the initial mean and covariance, which every filter is given.

    ## Episode End

    Truncation after `horizon` measurements.

    ## Version History

    * v0: first release
    """

    definition: ClassVar[StateSpaceDefinition]
    paper_source = "none: a model of one's own"
    Parameters = StateSpaceParameters
    World = StateSpaceWorld
    live_input = StateSpaceInput
    causes = (MISSED, OUTLIER)
    cost_description = "weighted squared error of the components"
    reward = "log-relative"
    reach: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "noise": ("noise_decades",),
        "gain": ("gain_factor",),
        "evidence": ("evidence_scale",),
    }

    def set_up(self) -> None:
        """Put the models that the filters believe on the task's arrays."""
        own = self.definition
        self.believed = [Equations(self, model) for model in own.filters]
        count = len(own.filters)
        self.modes = tuple(f"hypothesis_{j}" for j in range(count)) if count > 1 else ()
        self.transition = self.constant([list(row) for row in own.transition])

    def _sampling_interval(self) -> float | None:
        """Return the time between measurements, s; None where it differs."""
        return None if self.parameters.jitter > 0.0 else self.parameters.sampling_interval


def state_space_attributes(
    definition: StateSpaceDefinition,
    names: Sequence[str],
    units: Sequence[str],
    measured: Sequence[str],
    defaults: dict[str, Any],
) -> dict[str, Any]:
    """Attributes of a task's class that follow from what its author gives.

    Args:
        definition: the models.
        names: of the components.
        units: of each.
        measured: names of what h returns.
        defaults: parameters in the training distribution, where they are not those of every such task.
    """
    from .state_space_banks import KalmanNetBank, bank_tables

    banks, actions = bank_tables(len(definition.filters))
    control = next(iter(banks))
    count = {"noise": 2, "evidence": len(definition.filters)}[control]
    jitter = Scenario(
        "jitter", "Held out: intervals from a tenth to 1.9 times the usual.", {**defaults, "jitter": 0.9}
    )
    places = _components_measured(definition.world[0].h)
    measured_units = [units[places.index(j)] if j in places else "1" for j in range(len(measured))]
    return {
        "definition": definition,
        "log_format": state_space_log_format(definition, measured, measured_units, defaults),
        "components": tuple(map(Component, names, units)),
        "banks": banks,
        "actions": actions,
        "trained_banks": {"kalman-net": KalmanNetBank},
        "scenarios": {
            "random": Scenario("random", "The model as it is given.", defaults, training=True),
            "rough": Scenario(
                "rough", "Held out: ten times the process noise.", {**defaults, "process_noise": (10.0, 10.0)}
            ),
            "noisy": Scenario(
                "noisy",
                "Held out: ten times the measurement noise.",
                {**defaults, "measurement_noise": (10.0, 10.0)},
            ),
            **({"jitter": jitter} if definition.world[0].timed else {}),
        },
        "paper_policy": PaperPolicy(control, (0.0,) * count),
    }
