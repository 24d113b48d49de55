"""The contract of every task.

A *task* is one estimation problem, written once for N independent episodes side by side. ``gym.Env`` is the
task with N = 1, the vector environment is the task with N, an evaluation is the task with N = Monte Carlo
runs. A task does not depend on Gymnasium and has no random generator: numbers come in, states come out.

It has two halves, and the :class:`Measurement <.model.Episode>` is the only connection between them:

* the :class:`World` draws the episode, moves the truth and returns the readings of the sensors;
* a :class:`~.filter.Filter` predicts and estimates. A task declares a :class:`~.filter.Bank` for each control, which
  also gives the observation and is steered by an action; :meth:`.Model.with_filter` replaces it with any other
  filter. No competing filter receives the truth, nor any other state of the world.

The clock of every task:

====  ==============================================================  =========================
 1    the truth advances; the sensors measure it                      :meth:`World.advance`
 2    the filter predicts to that time; innovations and likelihoods   :meth:`Filter.predict`
 3    the agent observes them                                         :meth:`.Model.observe`
 4    the filter updates with *that* measurement and the action       :meth:`Filter.update`
 5    the estimate is compared with the truth                         :meth:`World.cost`
====  ==============================================================  =========================

``begin`` makes the episode at the start of the track, as if step 4 had just happened: :meth:`World.begin`
gives the initial estimate to :meth:`Filter.start`. A reset is ``begin``, 1, 2, 3; an
environment step is 4, 5, 1, 2, 3. So K actions need K + 1 measurements, and the last observation is that of a
real measurement that is not acted on.

A :class:`Task` is the declaration of an author; :class:`TaskBase` derives the rest from it: the parameters, the
constants computed from them and the world. Optional objects beside it, such as the format of logs, are
:mod:`~.companions`. The engine runs a :class:`~.model.Model`: a task with a filter in the loop.

Arrays inside a task have the batch as their last axis and belong to the namespace ``task.xp`` (NumPy or
torch). Truth, measurement and the filter's state are NamedTuples of arrays ``(..., N)`` and are never changed
in place.

A closed loop adds a path back from the estimate to the world: the result of :meth:`Task.feedback` is an argument of
the next :meth:`World.advance`. Each filter then has a truth of its own, on the same noise.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

from .filter import Bank
from .observation import Array
from .task_base import TaskBase
from .world import World

Banks = Mapping[str, type[Bank[Any, Any, Any]]]
"""Class of the bank of each control, by its name."""


class Component(NamedTuple):
    """One component of the estimation error."""

    name: str
    unit: str
    period: float | None = None
    """Period of an angle, in its unit: errors are the shortest differences. None: it is no angle."""
    group: str = ""
    """Group of components combined into one error, such as ``position``: the root of their summed squares; empty: none."""


@dataclass(frozen=True)
class Scenario:
    """A named immutable set of parameters, and the windows in which its errors are reported."""

    name: str
    description: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    windows: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """First and last measurement of each window, both included; measurement 1 is the first one acted on. An
    evaluation adds the window ``all``, the whole episode."""
    training: bool = False
    """Whether agents may be trained and policies tuned on it."""
    flights: tuple[str, ...] = ()
    """Names of the flights, of which every episode flies one; the name of a flight is repeated for each of its
    pieces."""
    notes: tuple[str, ...] = ()
    """Notes on where it comes from, a line each."""
    recording: Any = None
    """A :class:`~.recording.Recording` that is replayed in place of a simulated world."""


class PaperPolicy(NamedTuple):
    """The algorithm of the source paper as a constant action."""

    control: str
    action: tuple[float, ...]


class Reward(NamedTuple):
    """Description of a task's cost, its default kind of reward, and their units."""

    cost: str
    """Meaning and unit of the cost, in words."""
    kind: str = "cost"
    """Default kind of reward, see :mod:`.reward`."""
    unit: float = 1.0
    """Mean cost of the paper's algorithm in the default scenario, as far as the reward counts it: the unit of the reward. Where
    few lost tracks dominate that mean, a value between it and the median."""
    log_unit: float | None = None
    """Unit of the reward ``log-relative``, about the cost of an ordinary episode, where that is far below ``unit``;
    None where it equals ``unit``."""


class Task(TaskBase):
    """Base class of an estimation problem for N independent episodes; see the module's description.

    Subclasses declare the class attributes below. Their class docstring is the environment's documentation.
    :class:`TaskBase` derives the rest from the declaration.
    """

    id: ClassVar[str]
    """Gymnasium id, with version."""
    interface: ClassVar[int] = 1
    """Version of the meanings of fields and actions. An author increases it when they change under the same names:
    agents that were trained before are then refused."""
    Parameters: ClassVar[type]
    """Frozen dataclass of every constant; its fields are keywords of ``gym.make``."""
    World: ClassVar[type[World[Any, Any, Any]]]
    """Truth and sensors."""
    banks: ClassVar[Banks]
    """Controls and the bank of each; the first is the default."""
    controls: ClassVar[tuple[str, ...]]
    scenarios: ClassVar[Mapping[str, Scenario]]
    default_scenario: ClassVar[str] = "random"
    reward: ClassVar[Reward]
    """Cost of an estimate, and the reward for it."""
    components: tuple[Component, ...]
    """Components of the estimate. This and the two attributes below may be set for each instance."""
    modes: tuple[str, ...] = ()
    """Names of the hypotheses of the bank; their probabilities are recorded when a bank reports them."""
    paper_policy: PaperPolicy
    companions: tuple[Any, ...] = ()
    """Objects that go with the problem, each found by its type (:func:`~.companions.find_companion`), such as the
    format of its logs or its picture. The first of a type counts, so that an instance may put another one in front."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if hasattr(cls, "banks"):
            cls.controls = tuple(cls.banks)

    def set_up(self) -> None:
        """Compute the constants that world and banks share; an optional method of an environment's author."""

    def feedback(self, mean: Array, covariance: Array, measurement: Any) -> Any:
        """Return the feedback of an estimate to the world, such as a control command; by default None, an open loop.

        A filter may return another one, see :meth:`.Filter.feedback`.

        Args:
            mean: of the estimate, ``(C, N)``.
            covariance: that is reported for it, ``(C, C, N)``.
            measurement: of the last update, or the initial estimate.
        """
        return None

    def _writes_feedback(self) -> bool:
        return type(self).feedback is not Task.feedback


def named_arrays(part: Any, prefix: str = "") -> Iterator[tuple[str, Array]]:
    """Yield the arrays in nested NamedTuples with their names, joined by underscores."""
    for name, value in part._asdict().items():
        if isinstance(value, tuple):
            yield from named_arrays(value, f"{prefix}{name}_")
        elif value is not None:
            yield prefix + name, value


def field_texts(cls: type) -> dict[str, str]:
    """Return the docstrings below the fields of a class by name, each as one line; fields without one are left out."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):
        return {}
    lines = tree.body if isinstance(tree, ast.ClassDef) else []
    return {
        field.target.id: " ".join(below.value.value.split())
        for field, below in pairwise(lines)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        and isinstance(below.value.value, str)
    }  # fmt: skip


def field_words(cls: type) -> dict[str, str]:
    """Return the docstrings of a class's fields by name, without array shapes and clauses on None."""
    found = {}
    for name, text in field_texts(cls).items():
        words = re.sub(r"(, |^)``\([^`]*\)``\.?", "", text)
        words = re.sub(r"(^|[;.] ?)[^;.]*\bNone where [^;.]*", "", words)
        found[name] = words.lstrip(" ,;").replace("`", "")
    return found
