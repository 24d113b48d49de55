"""What stands in an environment's table of baselines."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..evaluation.competitors import Policy
from .alarm import Alarm

if TYPE_CHECKING:  # it takes xarray, and `import filtergym` does not
    from ..evaluation.own_metrics import OwnMetrics


@dataclass(frozen=True)
class Tunable:
    """What can be tuned in a policy or an estimator, and what a choice of values means."""

    control: str | None
    """The control of the policy; None for an estimator."""
    limits: Mapping[str, tuple[float, float]]
    """Lower and upper limit of each value, in the order of the search."""
    start: Mapping[str, float]
    """The values in force without tuning."""
    apply: Callable[[Mapping[str, float]], tuple[dict[str, Any], Callable[[Any], Any]]]
    """From values to keywords of the task and what makes the policy or estimator for it."""


@dataclass(frozen=True)
class Baselines:
    """What an environment is compared with: the table at the end of each module ``policies``."""

    environment: str
    """Gymnasium id."""
    policies: Mapping[str, Callable[[Any], Policy]]
    references: Mapping[str, Any] = field(default_factory=dict)
    """Classes that keep the protocol :class:`.Reference`."""
    bounds: Mapping[str, Any] = field(default_factory=dict)
    """Classes that keep the protocol :class:`.Bound`."""
    estimators: Mapping[str, Any] = field(default_factory=dict)
    """Classes that keep the protocol :class:`.Estimator`."""
    score_paper: str = ""
    """The policy whose score is 0."""
    score_reference: str = ""
    """The reference estimator or bound whose score is 1."""
    benchmark: tuple[str, ...] = ()
    """Names that the quick benchmark runs, in the order of the table."""
    compared: tuple[str, ...] = ()
    """Untuned policies that learned agents are compared with, beside the paper's and the tuned ones."""
    physical: tuple[str, str] = ("rmse", "position")
    """Metric and component that the comparison shows beside the cost."""
    measurement_seconds: float = 5e-6
    """Time that a policy takes for one measurement, on one core; dear environments get fewer episodes in the
    full benchmark."""
    tunable: Mapping[str, Tunable] = field(default_factory=dict)
    """Policies and estimators that :mod:`.tuning` can tune; ``NAME-tuned`` is the tuned one."""
    best_constant: str = ""
    """The tunable policy that stands for the best constant action in the room table."""
    metrics: "OwnMetrics | None" = None
    """The environment's own."""

    alarm: Callable[[Any], Alarm] | None = None
    """Class that says from observations that something is wrong, for any control; None: the general one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Every name, policies first."""
        return (*self.policies, *self.estimators, *self.references, *self.bounds)
