"""Companions of a problem: optional objects beside its declaration, found by their types.

:attr:`.Task.companions` lists them, and their users find them with :func:`find_companion`. Further ones are
:class:`~.causes.Causes`, :class:`~.live_input.LiveReader`, :class:`~.log_format.LogFormat`.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from .observation import Array

Companion = TypeVar("Companion")


def find_companion(task: Any, kind: type[Companion]) -> Companion | None:
    """Return the first companion of a task, or of a class of tasks, that is of this type; None if there is none."""
    return next((one for one in task.companions if isinstance(one, kind)), None)


class Paper(NamedTuple):
    """Source paper of a problem: its citation."""

    source: str
    """Reference of the paper."""


class Actions(NamedTuple):
    """Descriptions of a task's actions by control, and the parameters that set their range."""

    meanings: Mapping[str, str]
    """Meaning of an action in words, by the name of the control."""
    reach: Mapping[str, tuple[str, ...]] = {}
    """Parameters that fix the range of an action, by control or trained bank. A learned policy runs with those that it
    was trained with, and with its decision interval: with others the same numbers would be other actions."""


class TrainedBanks(NamedTuple):
    """Banks of filters that a trained network steers: learned estimators.

    Training treats them as any other bank. No other policy acts in them.
    """

    banks: Mapping[str, type]
    """The bank, by the algorithm that trains it."""


class LostTracks(NamedTuple):
    """Criterion of a lost track, and the explanation of a loss."""

    cost: float | None = None
    """Mean cost of an episode beyond which its track counts as lost; None where it is not declared."""
    explain: Callable[[Any, Array, Array, Any], str] | None = None
    """Function of the task, the last valid mean ``(C, N)``, its covariance ``(C, C, N)`` and the following
    measurement, of N lanes. It returns a sentence on why the filter lost an episode there, empty if there is no
    explanation."""


class ArrayMeanings(NamedTuple):
    """Descriptions of a task's measurement and feedback arrays, for users of another program."""

    measurement: str = ""
    """Meaning of the numbers of a measurement, in a sentence; empty where the names suffice."""
    feedback: str = ""
    """Meaning of the feedback that a filter may report beside its estimate; empty where the feedback follows from the
    estimate."""


class PictureMaker(NamedTuple):
    """Function that creates the picture of an episode where the general picture is not enough."""

    make: Callable[[Any], Any]
    """Function from a model to its :class:`~.rendering.Picture`, or None for the general one. It imports the drawing
    library."""


class FlightScenarios(NamedTuple):
    """Function that makes a scenario in which every episode flies one of a user's flights."""

    make: Callable[[Any, Mapping[str, Any]], Any]
    """Function from a :class:`~.trajectory.Trajectory` or :class:`~.flights.Flights` and the keywords of
    ``gym.make`` beside the scenario to a :class:`~.task.Scenario`; raises :class:`ValueError` for flights that
    cannot be flown."""


class LoopRecords(NamedTuple):
    """Values to record at each measurement beside those of filter and world."""

    report: Callable[[Any, Any, dict[str, Array]], dict[str, Array]]
    """Function of the model, the episode after the action, and the records of filter and world; it returns further
    records, see :meth:`.Filter.records`."""


def trained_banks(task: Any) -> Mapping[str, type]:
    """Return the classes of the learned estimators' banks of a task or class of tasks, by training algorithm."""
    found = find_companion(task, TrainedBanks)
    return {} if found is None else found.banks


def action_reach(task: Any, control: str) -> tuple[str, ...]:
    """Return the names of the parameters that set the range or duration of an action of a control.

    The duration belongs to every control; the network of a trained bank acts at each measurement.
    """
    found = find_companion(task, Actions)
    reach = () if found is None else found.reach.get(control, ())
    return reach if control in trained_banks(task) else (*reach, "decision_interval")


def action_meanings(task: Any) -> Mapping[str, str]:
    """Return a description of the actions of a task, by the name of the control."""
    found = find_companion(task, Actions)
    return {} if found is None else found.meanings


def lost_cost(task: Any) -> float | None:
    """Return the mean cost of an episode above which its track counts as lost; None where the task has no limit."""
    found = find_companion(task, LostTracks)
    return None if found is None else found.cost


def array_meanings(task: Any) -> ArrayMeanings:
    """Return the descriptions of a task's measurement and feedback arrays; empty texts where it has none."""
    return find_companion(task, ArrayMeanings) or ArrayMeanings()
