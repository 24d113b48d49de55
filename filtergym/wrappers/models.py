"""State-space models of environments: of Gymnasium's classic control, and of one's own.

The equations are those of the simulators in ``gymnasium.envs.classic_control`` (Gymnasium 1.x), written without
branches: CartPole and Pendulum by one Euler step, MountainCarContinuous by its map of one step, Acrobot by one step of
the Runge-Kutta method of order 4 of the book's equations (Sutton and Barto, Reinforcement Learning, 1998). They are
exact but for the 32 bits of the observations, so their process noise only allows for the filter's linearisation.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy

from .recursions import Array


@dataclass(frozen=True, eq=False)
class EnvironmentModel:
    """Motion of an environment's state, and how the state is read from an observation.

    Raises:
        ValueError: for numbers of components that do not fit each other.
    """

    names: Sequence[str]
    """Of the n components of the state."""
    f: Callable[..., Any]
    """State ``dt`` s later, ``f(x, dt)`` or ``f(x, dt, u)``: n numbers, in NumPy's functions and without branches."""
    interval: float
    """Between two steps, s."""
    noise: Any
    """Spectral density of the process noise: of each component ``(n,)``, or ``(n, n)``; Q is ``dt`` times this."""
    mean: Any
    """Of the state at the start of an episode, ``(n,)``."""
    covariance: Any
    """Of the state there: variances ``(n,)``, or ``(n, n)``."""
    inputs: Sequence[str] = ()
    """Names of the p inputs in which the action enters f."""
    angles: Mapping[str, str] = field(default_factory=dict)
    """Components that are angles, ``"rad"`` or ``"deg"`` by their names."""
    state: Callable[[Array], Array] = numpy.asarray
    """State ``(N, n)`` of full observations ``(N, fields)``; default: the observation is the state."""
    observation: Callable[[Array], Array] | None = None
    """Observations ``(N, fields)`` of states ``(N, n)``; None: an estimate has no other form than the state's."""
    action: Callable[[Array], Array] | None = None
    """Inputs ``(N, p)`` of actions ``(N, ...)``; None: the actions themselves."""

    def __post_init__(self) -> None:
        n = len(self.names)
        for name in ("noise", "mean", "covariance"):
            shape = numpy.shape(getattr(self, name))
            if shape != (n,) and (name == "mean" or shape != (n, n)):
                raise ValueError(f"{name} of the model must be of its {n} components, got the shape {shape}")

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle a model of :data:`CLASSIC_CONTROL` by its name."""
        names = [name for name, model in CLASSIC_CONTROL.items() if model is self]
        return (find_model, (names[0], None)) if names else super().__reduce_ex__(protocol)

    def matrix(self, name: str) -> Array:
        """Return ``noise`` or ``covariance`` as a matrix, ``(n, n)``."""
        given = numpy.asarray(getattr(self, name), dtype=float)
        return numpy.diag(given) if given.ndim == 1 else given

    def inputs_of(self, actions: Any, xp: Any = numpy) -> Any:
        """Return the inputs ``(N, p)`` of actions ``(N, ...)``, arrays of a namespace."""
        found = xp.asarray(actions if self.action is None else self.action(actions))
        return xp.reshape(xp.astype(found, xp.float64), (actions.shape[0], -1))


def _cart_pole(x: Any, dt: Any, u: Any) -> list[Any]:
    sin, cos = numpy.sin(x[2]), numpy.cos(x[2])
    total, moment, half = 1.1, 0.05, 0.5  # kg, kg m, m
    push = (u[0] + moment * x[3] * x[3] * sin) / total
    angular = (9.8 * sin - cos * push) / (half * (4.0 / 3.0 - 0.1 * cos * cos / total))
    linear = push - moment * angular * cos / total
    return [x[0] + dt * x[1], x[1] + dt * linear, x[2] + dt * x[3], x[3] + dt * angular]


def _pendulum(x: Any, dt: Any, u: Any) -> list[Any]:
    rate = numpy.clip(x[1] + dt * (15.0 * numpy.sin(x[0]) + 3.0 * u[0]), -8.0, 8.0)
    return [x[0] + dt * rate, rate]


def _mountain_car(x: Any, dt: Any, u: Any) -> list[Any]:
    velocity = numpy.clip(x[1] + dt * (0.0015 * u[0] - 0.0025 * numpy.cos(3.0 * x[0])), -0.07, 0.07)
    position = numpy.clip(x[0] + dt * velocity, -1.2, 0.6)
    return [position, numpy.where(position <= -1.2, numpy.maximum(velocity, 0.0), velocity)]


def _acrobot_rates(x: Sequence[Any], torque: Any) -> list[Any]:
    # Masses, lengths and moments of inertia are one, centres of mass in the middle of the links.
    sin, cos = numpy.sin(x[1]), numpy.cos(x[1])
    d1, d2 = 3.5 + cos, 1.25 + 0.5 * cos
    phi2 = 0.5 * 9.8 * numpy.sin(x[0] + x[1])
    phi1 = -0.5 * x[3] * x[3] * sin - x[3] * x[2] * sin + 1.5 * 9.8 * numpy.sin(x[0]) + phi2
    second = (torque + d2 / d1 * phi1 - 0.5 * x[2] * x[2] * sin - phi2) / (1.25 - d2 * d2 / d1)
    return [x[2], x[3], -(d2 * second + phi1) / d1, second]


def _acrobot(x: Any, dt: Any, u: Any) -> list[Any]:
    def after(rates: Sequence[Any], share: float) -> list[Any]:
        return [x[i] + share * dt * rates[i] for i in range(4)]

    a = _acrobot_rates([x[i] for i in range(4)], u[0])
    b = _acrobot_rates(after(a, 0.5), u[0])
    c = _acrobot_rates(after(b, 0.5), u[0])
    d = _acrobot_rates(after(c, 1.0), u[0])
    moved = [x[i] + dt / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]) for i in range(4)]
    limits = (4.0 * numpy.pi, 9.0 * numpy.pi)
    return [*moved[:2], *(numpy.clip(moved[2 + i], -limit, limit) for i, limit in enumerate(limits))]


CLASSIC_CONTROL = {
    "CartPole": EnvironmentModel(
        names=("position", "velocity", "angle", "rate"), f=_cart_pole, interval=0.02, noise=(1e-6, 1e-3, 1e-6, 1e-3),
        mean=(0.0,) * 4, covariance=(0.1**2 / 12.0,) * 4, inputs=("force",),
        action=lambda action: numpy.where(action == 1, 10.0, -10.0)[:, None],
    ),
    "Pendulum": EnvironmentModel(
        names=("angle", "rate"), f=_pendulum, interval=0.05, noise=(1e-6, 1e-3),
        mean=(0.0, 0.0), covariance=(numpy.pi**2 / 3.0, 1.0 / 3.0), inputs=("torque",), angles={"angle": "rad"},
        state=lambda o: numpy.array([numpy.arctan2(o[:, 1], o[:, 0]), o[:, 2]]).T,
        observation=lambda x: numpy.array([numpy.cos(x[:, 0]), numpy.sin(x[:, 0]), x[:, 1]]).T,
        action=lambda action: numpy.minimum(numpy.maximum(action, -2.0), 2.0),
    ),
    "MountainCarContinuous": EnvironmentModel(
        names=("position", "velocity"), f=_mountain_car, interval=1.0, noise=(1e-10, 1e-9),
        mean=(-0.5, 0.0), covariance=(0.2**2 / 12.0, 1e-10), inputs=("force",),
        action=lambda action: numpy.minimum(numpy.maximum(action, -1.0), 1.0),
    ),
    "Acrobot": EnvironmentModel(
        names=("angle_1", "angle_2", "rate_1", "rate_2"), f=_acrobot, interval=0.2, noise=(1e-5, 1e-5, 1e-3, 1e-3),
        mean=(0.0,) * 4, covariance=(0.2**2 / 12.0,) * 4, inputs=("torque",),
        angles={"angle_1": "rad", "angle_2": "rad"},
        state=lambda o: numpy.array(
            [numpy.arctan2(o[:, 1], o[:, 0]), numpy.arctan2(o[:, 3], o[:, 2]), o[:, 4], o[:, 5]]).T,
        observation=lambda x: numpy.array(
            [numpy.cos(x[:, 0]), numpy.sin(x[:, 0]), numpy.cos(x[:, 1]), numpy.sin(x[:, 1]), x[:, 2], x[:, 3]]).T,
        action=lambda action: action[:, None] - 1.0,
    ),
}  # fmt: skip
"""Models by the names of Gymnasium's environments, without versions."""


def find_model(model: Any, spec: Any) -> EnvironmentModel | None:
    """Return a model that is given itself or by name, or by default that of the environment; None where it has none.

    Args:
        model: an :class:`EnvironmentModel`; a name of :data:`CLASSIC_CONTROL`, with or without a version;
            ``"module:attribute"`` of one of yours, which is imported; or None.
        spec: of the environment, or None.
    """
    if isinstance(model, EnvironmentModel):
        return model
    name = str(getattr(spec, "id", "") if model is None else model)
    found: Any = CLASSIC_CONTROL.get(name.rpartition("/")[2].rpartition("-v")[0] or name)
    if model is None:
        if found is not None and spec.kwargs.get("g", 10.0) != 10.0:
            raise ValueError(
                f"the model of {name} is that of g = 10, and this one has g = {spec.kwargs['g']}: give model="
            )
        return found
    module, colon, attribute = name.partition(":")
    if colon:
        found = getattr(importlib.import_module(module), attribute, None)
    if isinstance(found, EnvironmentModel):
        return found
    raise ValueError(
        f"model must be an EnvironmentModel, 'module:attribute' of one, or one of {', '.join(CLASSIC_CONTROL)}, got "
        f"{model!r}"
    )
