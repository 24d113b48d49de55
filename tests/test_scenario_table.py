"""Every scenario's parameters and windows, held as data: a distribution that changes has to be changed here, too.

``scenarios.json`` holds for every environment what its parameters are by default, and for every scenario those that
differ, its windows and whether it is for training. To accept a change, run

    python tests/test_scenario_table.py

and look at the difference. A change of what an episode is raises the task's ``interface``, too:
``test_golden_trajectories.py``.
"""

import dataclasses
import json
from pathlib import Path

import pytest
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
            "windows": scenario.windows,
            "parameters": {key: value for key, value in own.items() if value != defaults[key]},
        }
    return json.loads(json.dumps({"defaults": defaults, "scenarios": scenarios}, default=dict))


@pytest.mark.parametrize("part", ["defaults", "scenarios"])
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
        f'"{env_id}": {{"defaults": {{\n'
        + ",\n".join(f'"{key}": {json.dumps(value)}' for key, value in found["defaults"].items())
        + '\n}, "scenarios": {\n'
        + ",\n".join(f'"{key}": {json.dumps(value)}' for key, value in found["scenarios"].items())
        + "\n}}"
        for env_id, found in ((env_id, table(cls)) for env_id, cls in catalogue().items())
    ]
    FILE.write_text("{\n" + ",\n".join(rows) + "\n}\n")
