"""Parameters of scenarios and of competitors, held as data: a number that changes has to be changed here, too.

``scenarios.json`` holds for every environment what its parameters are by default, for every scenario those that differ,
its windows and whether it is for training, for every competitor that ships the parameters that it is made with, and for
what can be tuned its values and their limits. To accept a change, run

    python tests/test_scenario_table.py

and look at the difference. A change of what an episode is raises the task's ``interface``, too:
``test_golden_trajectories.py``.
"""

import dataclasses
import inspect
import json
from pathlib import Path

import pytest

from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.table import Variant
from filtergym.envs.engine.catalogue import catalogue

FILE = Path(__file__).parent / "scenarios.json"


def table(cls):
    """Default parameters of an environment, and every scenario's own, as JSON keeps them."""
    defaults = dataclasses.asdict(cls.Parameters())
    scenarios = {}
    for name, scenario in cls.scenarios.items():
        own = dataclasses.asdict(cls.Parameters(**scenario.parameters))
        scenarios[name] = {
            "training": scenario.training,
            "windows": dict(scenario.windows),
            "parameters": {key: value for key, value in own.items() if value != defaults[key]},
        }
    known = baselines_of(cls.id)
    competitors = {
        name: settings(maker)
        for kind in (known.policies, known.estimators, known.smoothers, known.references, known.bounds)
        for name, maker in kind.items()
    }
    tunable = {name: {"limits": each.limits, "start": each.start} for name, each in known.tunable.items()}
    parts = {"defaults": defaults, "scenarios": scenarios, "competitors": competitors, "tunable": tunable}
    return json.loads(json.dumps(parts, default=repr))


def settings(maker):
    """Parameters that a competitor is made with: those that its class has by default, and those of its variant."""
    parameters = inspect.signature(maker.func if isinstance(maker, Variant) else maker).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
    values = {**defaults, **(maker.keywords if isinstance(maker, Variant) else {})}
    return {name: value._asdict() if hasattr(value, "_asdict") else value for name, value in values.items()}


@pytest.mark.parametrize("part", ["defaults", "scenarios", "competitors", "tunable"])
def test_scenarios_are_the_stored_ones(env_id, part):
    stored, found = json.loads(FILE.read_text())[env_id][part], table(catalogue()[env_id])[part]
    assert list(found) == list(stored)
    for name, expected in stored.items():
        assert found[name] == expected, name


def test_windows_lie_in_the_episode(env_id):
    cls = catalogue()[env_id]
    for name, scenario in cls.scenarios.items():
        horizon = cls.Parameters(**scenario.parameters).horizon
        for first, last in scenario.windows.values():
            assert 1 <= first <= last <= horizon, name


if __name__ == "__main__":
    rows = [
        f'"{env_id}": {{'
        + ", ".join(
            f'"{part}": {{\n'
            + ",\n".join(f'"{key}": {json.dumps(value)}' for key, value in values.items())
            + "\n}"
            for part, values in found.items()
        )
        + "}"
        for env_id, found in ((env_id, table(cls)) for env_id, cls in catalogue().items())
    ]
    FILE.write_text("{\n" + ",\n".join(rows) + "\n}\n")
