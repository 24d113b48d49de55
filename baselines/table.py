"""Tables of an environment's baselines and of their tunable values."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy

from ..envs.contract.model import Model
from ..evaluation.competitors.kinds import ConstantPolicy, Policy
from .alarm import Alarm

if TYPE_CHECKING:
    from ..envs.data.recording import Recording

if TYPE_CHECKING:  # it takes xarray, and `import filtergym` does not
    from ..evaluation.running.own_metrics import OwnMetrics


@dataclass(frozen=True)
class Tunable:
    """The tunable values of a policy or an estimator, and how to apply them."""

    control: str | None
    """The control of the policy; None for an estimator."""
    limits: Mapping[str, tuple[float, float]]
    """Lower and upper limit of each value, in the order of the search."""
    start: Mapping[str, float]
    """The values in force without tuning."""
    apply: Callable[[Mapping[str, float]], tuple[dict[str, Any], Callable[[Any], Any]]]
    """Function from values to keywords of the task and the maker of the policy or estimator for it."""
    in_lanes: bool = True
    """Whether values may be arrays ``(N,)``, one for each episode: candidates are then tried side by side."""
    beyond: Mapping[str, float] = field(default_factory=dict)
    """How far beyond its limits a value of a file may lie, since the limits of another recording may have been
    wider.
    """
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of the values, without their logarithm; a value without an entry is a pure number."""
    likelihood: bool = False
    """Whether a search weighs the density of the truth in addition to the cost: a filter with few hypotheses has its
    lowest cost where its covariance is too small.
    """
    anchored: bool = False
    """Whether it uses a second sensor of the motion, with which it distinguishes lasting errors from motion. The search
    for the best filter of a log fits it to measurements some time apart, and compares it with other filters on these
    (:mod:`.advice`).
    """


def tunable(
    make: Callable[..., Any],
    apply: Callable[[Mapping[str, float]], tuple[dict[str, Any], Callable[[Any], Any]]] | None = None,
    /,
    **values: tuple[float, float, float],
) -> Tunable:
    """Declare which keywords of a policy or an estimator can be tuned, and their limits.

    Args:
        make: its class, or a :class:`Variant`.
        apply: as in :class:`Tunable`; default: every value is a keyword of ``make``. A value whose name begins with
            ``log10_`` is the logarithm of the keyword, for a keyword of unknown order of magnitude.
        **values: lower limit, value in force without tuning, upper limit.
    """

    def keywords(chosen: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Any]]:
        own = dict(getattr(make, "task_keywords", {}))
        return own, functools.partial(make, **without_logarithms(chosen))

    return Tunable(
        getattr(make, "control", None),
        {name: (low, high) for name, (low, _, high) in values.items()},
        {name: start for name, (_, start, _) in values.items()},
        apply or keywords,
    )


def without_logarithms(values: Mapping[str, float]) -> dict[str, float]:
    """Return values by keyword: ``10 ** value`` for names that begin with ``log10_``, which the keyword
    omits.
    """
    return {
        name.removeprefix("log10_"): 10.0**value if name.startswith("log10_") else value
        for name, value in values.items()
    }


class Variant(functools.partial[Any]):
    """A competitor's class with some arguments bound, and its own description.

    It has the attributes of the class, such as ``control`` and ``kind``.
    """

    def __new__(cls, make: Callable[..., Any], description: str = "", /, **arguments: Any) -> "Variant":
        """Bind arguments of a competitor's class, with a description of the result.

        Args:
            make: the class.
            description: a sentence for the page of the environment.
            **arguments: arguments of the class after the problem.
        """
        variant = super().__new__(cls, make, **arguments)
        variant.__doc__ = description
        return variant

    def __getattr__(self, name: str) -> Any:
        return getattr(self.func, name)


class PaperAction(ConstantPolicy):
    """The paper's algorithm as a constant action; subclasses name its control."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.action: tuple[float, ...] = model.task.paper_policy.action


class ConstantMode(Policy):
    """A policy that always chooses the same mode."""

    control = "mode"
    traceable = True

    def __init__(self, model: Model, mode: int) -> None:
        super().__init__(model)
        self.mode: int = mode if mode >= 0 else len(model.task.modes) + mode

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the constant mode as action of every episode, ``(N,)``, and no memory."""
        return numpy.full(len(observation), self.mode), None


@dataclass(frozen=True)
class Baselines:
    """Baselines of an environment: the table at the end of each module ``policies``."""

    environment: str
    """Gymnasium id."""
    policies: Mapping[str, Callable[[Any], Policy]]
    references: Mapping[str, Any] = field(default_factory=dict)
    """Classes that implement the protocol :class:`.Reference`."""
    bounds: Mapping[str, Any] = field(default_factory=dict)
    """Classes that implement the protocol :class:`.Bound`."""
    estimators: Mapping[str, Any] = field(default_factory=dict)
    """Classes that implement the protocol :class:`.Estimator`."""
    smoothers: Mapping[str, Any] = field(default_factory=dict)
    """Classes that implement the protocol :class:`.Smoother`: estimators that use later measurements."""
    score_paper: str = ""
    """The policy whose score is 0."""
    stronger_paper: str = ""
    """Another reading of the paper's algorithm, of less cost: where it takes part, it replaces the paper's as the base
    of costs and has score 0.
    """
    score_reference: str = ""
    """The reference estimator or bound whose score is 1."""
    benchmark: tuple[str, ...] = ()
    """Names in the quick benchmark, in the order of the table."""
    compared: tuple[str, ...] = ()
    """Untuned policies that learned agents are compared with, in addition to the paper's and the tuned ones."""
    physical: tuple[str, str] = ("rmse", "position")
    """Metric and component that the comparison shows in addition to the cost."""
    measurement_seconds: float = 5e-6
    """Time that a policy takes for one measurement, on one core; slow environments get fewer episodes in the full
    benchmark.
    """
    headline_episodes: int = 0
    """Smallest number of episodes of the training distribution in a benchmark with narrow intervals; costs with heavy
    tails need many.
    """
    tunable: Mapping[str, Tunable] = field(default_factory=dict)
    """Tunable values of policies and estimators, by name; ``NAME-tuned`` is the tuned one."""
    log_families: "Callable[[Recording | None], Mapping[str, Tunable]] | None" = None
    """Function of a recording (None: any) that returns the families of estimators to fit to it, with limits that suit
    it; default: those of ``tunable``.
    """
    best_constant: str = ""
    """Tunable policy that represents the best constant action in the table of the room for improvement."""
    metrics: "OwnMetrics | None" = None
    """Metrics of the environment, in addition to the general ones."""

    fallback: str = ""
    """Policy or estimator that replaces an agent behind a gate while the agent is not trusted. It is a classical filter
    that is neither tuned on the training distribution nor uses it as a prior, since it acts outside the training
    distribution: the one of least cost on the validation split; of those within 1 % of the paper's cost the quickest.
    Empty: the paper's algorithm.
    """
    alarm: Callable[[Any], Alarm] | None = None
    """Class of the alarm that detects faults from observations, for any control; None: :class:`.InnovationAlarm`."""

    @property
    def compared_paper(self) -> str:
        """Name of the paper's algorithm to which costs are relative: its stronger reading, if there is one."""
        return self.stronger_paper or self.score_paper

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all baselines, policies first."""
        return (*self.policies, *self.estimators, *self.smoothers, *self.references, *self.bounds)
