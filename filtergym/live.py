"""Run a competitor in a user's own loop."""

import dataclasses
from datetime import timedelta
from pathlib import Path
from typing import Any

from .baselines.problem import import_problem
from .envs.contract.parameters import ParameterLimits, check
from .envs.data.recorded_world import Feed
from .envs.engine.backend import make_model
from .envs.engine.scenario_choice import find_scenario
from .evaluation.competitors.kinds import Competitor, kind_of
from .evaluation.competitors.online import OnlineFilter
from .evaluation.running.evaluate import control_of
from .extensions import WATCHES, load_present
from .names import adopt, find_competitor


def online(
    env: str,
    policy: Any,
    control: str | None = None,
    scenario: Any = None,
    *,
    tracks: int = 1,
    regular: bool = False,
    second_sensor: bool = False,
    lag: int | timedelta = 0,
    backend: str = "auto",
    trust: bool = False,
    **keywords: Any,
) -> OnlineFilter:
    """Return a filter that runs in a loop of your own: a policy in its bank, an estimator, an agent, or yours.

    Call its ``start`` once, then ``update`` with every measurement.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        policy: a name or a path, see :func:`~filtergym.names.competitor`, or an object or a class as in
            :func:`~filtergym.evaluate`. A file of ``filtergym advise`` contains the interval, the noise level and the
            parameters of the log that it was advised for; where that log had latitude and longitude, also the origin of
            x and y, and ``update`` accepts latitude and longitude.
        control: control of the policy; by default its own.
        scenario: scenario that gives the parameters; default: the environment's.
        tracks: number of tracks side by side.
        regular: whether every measurement arrives, one sampling interval after the last; some filters are then simpler.
        second_sensor: whether a measurement contains fields that only recordings have, such as odometry; a filter that
            ``advise`` has fitted to such a recording uses them in any case.
        lag: largest delay of a measurement: a number of newer measurements, or a :class:`datetime.timedelta` to the
            newest one. The newer ones are stored, each with the state of the filter before it: in ManeuveringTarget
            from 5 kB each (``imm``) to 43 kB (``semi-markov-vague``), for each eight tracks begun. Default: times must
            increase.
        backend: implementation of the steps, "auto", "compiled" or "numpy".
        trust: whether to load a model's zip, which can execute code.
        **keywords: parameters of the task.

    Raises:
        ValueError: for unknown names, and for competitors that need the truth or later measurements.
    """
    problem = import_problem(env)
    for what, value in (("regular", regular), ("second_sensor", second_sensor), ("trust", trust)):
        check(what, value, bool, ParameterLimits())
    named = isinstance(policy, str | Path)
    name = str(policy) if named else type(policy).__name__
    found = find_competitor(problem, policy, trust) if named else Competitor(name, adopt(policy))
    maker, log = found.maker, found.log
    kind = kind_of(maker)
    if log is not None and scenario is None:
        scenario = log.scenario(problem.task)
    keywords = {**getattr(maker, "task_keywords", {}), **keywords}
    chosen = dataclasses.replace(
        find_scenario(problem.task, scenario, keywords),
        flights=(),
        recording=Feed(
            regular,
            second_sensor or getattr(maker, "anchored", False),
            () if log is None else tuple(log.deviations.items()),
            None if log is None else log.interval,
            None if log is None else log.plane,
        ),
    )
    own = control_of(maker, control, problem.task, name)
    model = make_model(problem.task, own, chosen, backend=backend, **keywords)
    watches = (watch_of(model, maker, kind) for watch_of in load_present(WATCHES))
    return OnlineFilter(model, maker, name, tracks, next(filter(None, watches), None), lag)
