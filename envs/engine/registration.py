"""Registration of a user's own environment in the catalogue."""

import dataclasses
import re
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, get_origin

import gymnasium
import numpy

from ..contract.causes import MOST_CAUSES, RESERVED, Causes
from ..contract.companions import action_meanings, trained_banks
from ..contract.failures import explain_errors
from ..contract.model import Episode, Model
from ..contract.task import Task
from .catalogue import USER_TASKS, catalogue, nearest, register

ID = re.compile(r"[\w-]+/[\w.-]+-v\d+")
WIDTH = 24
"""Episodes side by side in the check of a task: a multiple of eight, and unlikely as a size of other arrays of the
task."""


def add_task(cls: type[Task]) -> None:
    """Check a user's task, add it to the catalogue and register it with Gymnasium; a second time do nothing.

    Args:
        cls: class that fulfils the contract of :class:`.task.Task`.

    Raises:
        ValueError: if it does not fulfil the contract, or another environment has its id.
    """
    _check_contract(cls)
    if USER_TASKS.get(cls.id) is cls:
        return
    if cls.id in catalogue():
        raise ValueError(
            f"environment {cls.id!r} is there already, from {catalogue()[cls.id].__module__}: choose another id"
        )
    USER_TASKS[cls.id] = cls
    register()


def _check_contract(cls: Any) -> None:
    if not (isinstance(cls, type) and issubclass(cls, Task)):
        raise ValueError(f"an environment is a subclass of filtergym.envs.contract.task.Task, got {cls!r}")
    name = cls.__name__
    declared = [n for n, hint in Task.__annotations__.items() if get_origin(hint) is ClassVar]  # type: ignore[comparison-overlap]
    missing = [n for n in declared if not hasattr(cls, n)]
    if missing:
        raise ValueError(f"{name} lacks the class attributes {', '.join(missing)} of a task")
    if not ID.fullmatch(cls.id):
        raise ValueError(
            f"{name} needs an id with your name and a version, such as 'mine/{name}-v0', got {cls.id!r}"
        )
    if not cls.banks:
        raise ValueError(f"{name} needs at least one control, got none")
    if cls.default_scenario not in cls.scenarios:
        raise ValueError(
            f"{name} needs its default scenario {cls.default_scenario!r} among its scenarios, got "
            f"{', '.join(cls.scenarios) or 'none'}"
        )
    fields = (
        {f.name for f in dataclasses.fields(cls.Parameters)}
        if dataclasses.is_dataclass(cls.Parameters)
        else set()
    )
    if not {"horizon", "decision_interval"} <= fields:
        raise ValueError(f"{name}.Parameters needs to be a dataclass with horizon and decision_interval")
    strange = action_meanings(cls).keys() - cls.banks.keys()
    if strange:
        raise nearest(f"control in actions of {name}", min(strange), cls.banks)
    for key, scenario in cls.scenarios.items():
        if key != scenario.name:
            raise ValueError(f"scenario {scenario.name!r} of {name} has the key {key!r} in scenarios")
        unknown = set(scenario.parameters) - fields
        if unknown:
            raise ValueError(
                f"scenario {scenario.name!r} of {name} sets unknown parameters {', '.join(sorted(unknown))}"
            )
    expected = [n for n in Task.__annotations__ if n not in declared and not hasattr(Task, n)]
    for control in (*cls.controls, *trained_banks(cls)):
        with explain_errors(f"{name} cannot be made with control {control!r}"):
            model = Model(cls(cls.Parameters(**cls.scenarios[cls.default_scenario].parameters)), control)
        missing = [attribute for attribute in expected if not hasattr(model.task, attribute)]
        if missing:
            raise ValueError(
                f"{_name_of(model)} needs {', '.join(missing)}: attributes of the class, or set by its set_up"
            )
        _check_action(model)
        _check_episodes(model)


def _check_action(model: Model) -> None:
    space: Any = model.action_space
    flat = isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1 and space.is_bounded()
    if not flat and not (isinstance(space, gymnasium.spaces.Discrete) and space.start == 0):
        raise ValueError(
            f"{_name_of(model)} needs as action space a Box of shape (A,) with finite limits, or a Discrete from 0 on, "
            f"got {space}"
        )
    paper = model.task.paper_policy
    if paper.control not in model.task.controls:
        raise nearest(
            f"control of paper_policy of {type(model.task).__name__}", paper.control, model.task.controls
        )
    if paper.control == model.control and flat and (len(paper.action),) != space.shape:
        raise ValueError(
            f"{_name_of(model)} has actions of shape {space.shape}, and its paper_policy has {paper.action!r}"
        )


def _check_causes(model: Model) -> None:
    names = [cause.name for cause in Causes.of(model.task).causes]
    twice = [name for name in names if names.count(name) > 1 or name in RESERVED]
    if twice or len(names) > MOST_CAUSES:
        what = f"the name {twice[0]!r}" if twice else f"{len(names)} of them"
        raise ValueError(
            f"{type(model.task).__name__} needs causes of different names, at most {MOST_CAUSES}, none of them "
            f"{', '.join(RESERVED)}, got {what}"
        )


def _check_episodes(model: Model) -> None:
    """Run a few episodes for two measurements and raise ValueError if results contradict the declaration."""
    random, noise, names = (
        numpy.random.default_rng(0),
        model.task.noise,
        [c.name for c in model.task.components],
    )
    count, space = len(names), model.action_space

    def measure(episode: Episode) -> Episode:
        normals = random.standard_normal((noise.normals, WIDTH))
        row = numpy.concatenate([normals, random.random((noise.row_uniforms, WIDTH))])
        return ask("measure", model.measure, episode, row)

    def ask(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        with explain_errors(f"{_name_of(model)} fails in {what}"):
            return function(*arguments)

    def check(what: str, values: Any, shape: tuple[int, ...] | None = None, finite: bool = True) -> None:
        numbers = isinstance(values, numpy.ndarray) and values.dtype.kind in "fiub"
        if not numbers or values.shape[-1:] != (WIDTH,) or shape not in (None, values.shape[:-1]):
            expected = f"(..., {WIDTH})" if shape is None else str((*shape, WIDTH))
            got = (
                f"{values.dtype} of shape {values.shape}"
                if hasattr(values, "dtype")
                else type(values).__name__
            )
            raise ValueError(
                f"{_name_of(model)}: {what} must be numbers of shape {expected}, {WIDTH} episodes on the last axis, "
                f"got {got}"
            )
        if finite and not numpy.isfinite(values).all():
            raise ValueError(f"{_name_of(model)}: {what} must be finite")

    uniforms, normals = random.random((noise.uniforms, WIDTH)), numpy.zeros((noise.initial_normals, WIDTH))
    start = ask("begin", model.begin, uniforms, normals)
    episode = measure(start)
    for block in model.filter.blocks:
        values = ask(f"block {block.name!r}", block.value, episode.filter, episode.measurement)
        check(f"block {block.name!r}", values)
        rows, fields = values.size // WIDTH, max(1, len(block.parts))
        if rows != fields:
            raise ValueError(
                f"{_name_of(model)}: block {block.name!r} has {rows} rows for {fields} "
                f"field{'s' if fields > 1 else ''}: name in its parts one ending for each row, got {block.parts!r}"
            )
    shown = ask("observe", model.observe, episode)
    check("the observation", shown, (len(model.fields),))
    for quantity in model.filter.quantities:
        values = ask(f"quantity {quantity.name!r}", model.reader(quantity.name), shown.T)
        if numpy.shape(values)[:1] != (WIDTH,) or numpy.ndim(values) != 2:
            raise ValueError(
                f"{_name_of(model)}: quantity {quantity.name!r} must have shape ({WIDTH}, parts), {WIDTH} episodes on "
                f"the first axis, got {numpy.shape(values)}"
            )
    if isinstance(space, gymnasium.spaces.Box):
        action = numpy.tile(numpy.clip(0.0, space.low, space.high)[:, None], WIDTH)
    else:
        action = numpy.zeros(WIDTH, int)
    episode = ask("act", model.act, episode, action)
    about = f" of the components {', '.join(names)}"
    shapes = {
        "mean": (count,),
        "covariance": (count, count),
        "error": (count,),
        "cost": (),
        "counted_cost": (),
    }
    for name, shape in shapes.items():
        values = ask(name, getattr(model, name), episode)
        check(name + (about if shape else ""), values, shape)
    for name, values in ask("records", model.records, episode).items():
        hypotheses = name == "mode_probability"
        check(f"record {name!r}", values, (len(model.task.modes),) if hypotheses else (), finite=False)
    for name, values in ask("context", model.context, episode).items():
        check(f"context {name!r}", values)
    _check_causes(model)
    for cause in Causes.of(model.task).causes:
        holds = ask(f"cause {cause.name!r}", cause.holds, model.moment(episode))
        if holds is not None:
            check(f"cause {cause.name!r}", holds, ())
    episode = measure(episode)  # with the feedback of the bank
    before = dict([*_leaves("truth", start.truth), *_leaves("filter's state", start.filter)])
    for part in ("truth", "measurement", "filter's state"):
        for name, values in _leaves(part, getattr(episode, part.partition("'")[0])):
            check(name, values, finite=False)
            first = numpy.shape(before.get(name, values))
            if first != values.shape:
                raise ValueError(
                    f"{_name_of(model)}: {name} must keep its shape, got {first} at the start of the track and "
                    f"{values.shape} after two measurements"
                )


def _leaves(name: str, part: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays in nested tuples and dictionaries with names such as "load of the truth".

    An object that is no array is yielded, too.
    """
    if isinstance(part, dict):
        for field, value in part.items():
            yield from _leaves(f"{field} of the {name}", value)
        return
    if isinstance(part, tuple):
        for field, value in zip(getattr(part, "_fields", range(len(part))), part, strict=True):
            yield from _leaves(f"{field} of the {name}", value)
    elif part is not None:
        yield name, part


def _name_of(model: Model) -> str:
    return f"{type(model.task).__name__} with control {model.control!r}"
