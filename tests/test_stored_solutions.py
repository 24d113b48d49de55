"""Solutions that are stored, computed anew; and that the environments start with them.

    python tests/test_stored_solutions.py

writes those of all scenarios and controls that are missing.
"""

import json

import gymnasium
import numpy as np
import pytest

import filtergym  # noqa: F401  (registers the environments)
from filtergym.envs.engine.catalogue import catalogue
from filtergym.filters import linear_systems, loosely_coupled, stored_solutions

ENTRIES = json.loads(stored_solutions.FILE.read_text()) if stored_solutions.FILE.exists() else []


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry["function"])
def test_a_stored_solution_is_what_scipy_finds(entry):
    solve = getattr(linear_systems, entry["function"])
    arguments = [part if isinstance(part, str) else np.array(part) for part in entry["arguments"]]
    given = [float(part) if getattr(part, "ndim", 1) == 0 else part for part in arguments]
    expected, found = solve.__wrapped__(*given), solve(*given)
    for own, other in zip(
        *(part if isinstance(part, tuple) else (part,) for part in (found, expected)), strict=True
    ):
        # Processors and versions of LAPACK round in other ways; entries differ by ten orders of magnitude.
        np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-13 * np.abs(other).max())
    assert found[0] is not solve(*given)[0]  # an array of its own


def test_other_numbers_are_solved_anew():
    F, Q = linear_systems.van_loan([[-1.0]], [[2.0]], 0.3)
    np.testing.assert_allclose([F[0, 0], Q[0, 0]], [np.exp(-0.3), 1.0 - np.exp(-0.6)], rtol=1e-14)


def write_missing():
    entries = {stored_solutions.key_of(entry["function"], *entry["arguments"]): entry for entry in ENTRIES}

    def storing(solve):
        def keep(*arguments):
            answer = solve(*arguments)
            parts = answer if isinstance(answer, tuple) else (answer,)
            key = stored_solutions.key_of(solve.__name__, *arguments)
            name, *given = json.loads(key)
            entries.setdefault(
                key, {"function": name, "arguments": given, "solution": [p.tolist() for p in parts]}
            )
            return answer

        return keep

    for module in (linear_systems, loosely_coupled):
        for name in ("zero_order_hold", "van_loan", "riccati_solution"):
            if hasattr(module, name):
                setattr(module, name, storing(getattr(module, name)))
    for id, task in catalogue().items():
        for scenario in task.scenarios:
            gymnasium.make(id, scenario=scenario)
    text = ",\n".join(json.dumps(entry) for entry in entries.values())
    stored_solutions.FILE.write_text(f"[\n{text}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    write_missing()
