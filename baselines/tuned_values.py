"""Stored tuned values of policies and estimators: the user's in ``tuned/``, and the shipped ones."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..envs.contract.parameters import quote_shortened
from ..envs.engine.catalogue import nearest, short_name
from ..evaluation.competitors.kinds import Kind
from ..evaluation.storage.files import whole_file
from ..evaluation.storage.stored import has_type, read_json
from .table import Tunable

FOLDER = Path("tuned")
"""Folder of the user's tuned values, below the working directory."""
PATIENCE = 60.0
"""Time for which a search waits for another one that writes the same file, s."""


@dataclass(frozen=True)
class Tuned:
    """Outcome of a search for tuned values of a policy or estimator."""

    environment: str
    policy: str
    scenario: str
    values: dict[str, float]
    cost: float
    """Geometric mean of the costs of episodes of the validation split; where the search weighs the likelihood, see
    :mod:`.tuning`, divided by that of the densities.
    """
    untuned_cost: float
    environment_steps: int
    seed: int


@dataclass(frozen=True, eq=False)
class TunedPolicy:
    """Maker of a policy or estimator with tuned values, some of which are parameters of the task."""

    task_keywords: dict[str, Any]
    control: str | None
    make: Callable[[Any], Any]
    content: str
    """Text that identifies the code and values; competitors with equal text are compiled once."""
    anchored: bool = False
    """Whether it uses a second sensor, which only recordings contain."""
    tunable: Tunable | None = None
    """Declaration of the tuned values, where it is known."""
    values: Mapping[str, float] = field(default_factory=dict)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TunedPolicy) and other.content == self.content

    def __hash__(self) -> int:
        return hash(self.content)

    @property
    def kind(self) -> Kind:
        """Kind of competitor, "policy" or "estimator"."""
        return "policy" if self.control else "estimator"

    def __call__(self, problem: Any) -> Any:
        """Make the policy for a model, or the estimator for a task."""
        return self.make(problem)


@dataclass(frozen=True)
class TunedValues:
    """Stored values of an environment's policies and estimators; files are read on first use."""

    environment: str
    """Gymnasium id."""
    tunable: Mapping[str, Tunable]
    places: Sequence[Any]
    """Files of tuned values, the user's first."""

    def _tables(self) -> Iterator[tuple[Any, dict[str, dict[str, Any]]]]:
        for place in self.places:
            yield place, read_table(place)

    def names(self) -> list[str]:
        """Return the names ``NAME-tuned`` of the policies and estimators that have stored values."""
        tables = [table for _, table in self._tables()]
        return [f"{policy}-tuned" for policy in self.tunable if any(policy in table for table in tables)]

    def is_improved(self, policy: str) -> bool:
        """Return whether the stored values of a policy differ from the untuned ones."""
        start = {name: round_value(value) for name, value in self.tunable[policy].start.items()}
        return self.values(policy)[0] != start

    def best_policy(self, control: str | None = None) -> str | None:
        """Return the name of the tuned policy of least cost on the validation split; None without one.

        Args:
            control: only policies of this control.
        """
        entries: dict[str, dict[str, Any]] = {}
        for _, table in reversed(list(self._tables())):  # the user's take precedence over the shipped ones
            entries |= table
        found = {
            f"{policy}-tuned": entries[policy].get("validation_cost", math.inf)
            for policy, tunable in self.tunable.items()
            if policy in entries and tunable.control is not None and control in (None, tunable.control)
        }
        return min(found, key=lambda name: found[name], default=None)

    def values(self, policy: str) -> tuple[dict[str, float], str]:
        """Return the stored values of a policy by name, and the path of their file."""
        for place, table in self._tables():
            if policy in table:
                return self._check(table[policy].get("values"), policy, place), str(place)
        raise ValueError(
            f"no tuned values of policy {policy!r}: run filtergym tune {self.environment} --policy {policy}"
        )

    def _check(self, values: Any, policy: str, place: Any) -> dict[str, float]:
        """Return stored values of a policy unchanged, or raise ValueError unless they are within its limits."""
        try:
            return check_values(values, self.tunable[policy])
        except ValueError as error:
            raise ValueError(
                f"{place}: policy {policy!r}: {error}: tune it again, or remove the file"
            ) from error

    def competitor(self, policy: str) -> TunedPolicy:
        """Return the maker of a policy or estimator with its stored values; raise ValueError without any."""
        if policy not in self.tunable:
            raise nearest("tunable policy", policy, self.tunable)
        tunable = self.tunable[policy]
        values = self.values(policy)[0]
        return make_tuned_policy(f"{self.environment} {policy}", tunable, values)


def check_values(values: Any, tunable: Tunable) -> dict[str, float]:
    """Return values from a file unchanged, or raise ValueError unless there is one in the limits for each
    parameter.
    """
    limits = tunable.limits
    if not has_type(values, dict[str, float]) or values.keys() != limits.keys():
        raise ValueError(
            f"it must give a number for each of {', '.join(limits)}, got {quote_shortened(values)}"
        )
    for name, (low, high) in limits.items():
        # Stored values are rounded, so that one at a limit can lie just beyond it.
        beyond = tunable.beyond.get(name, 0.0)
        if not min(low, round_value(low)) - beyond <= values[name] <= max(high, round_value(high)) + beyond:
            raise ValueError(
                f"{name} must be from {low - beyond:g} to {high + beyond:g}, got {quote_shortened(values[name])}"
            )
    found: dict[str, float] = values
    return found


def make_tuned_policy(name: str, tunable: Tunable, values: Mapping[str, float]) -> TunedPolicy:
    """Return the maker of a policy or estimator with these values."""
    keywords, make = tunable.apply(values)
    content = f"{name} {sorted(values.items())!r}"
    return TunedPolicy(keywords, tunable.control, make, content, tunable.anchored, tunable, values)


def round_value(value: float) -> float:
    """Return a value rounded to six significant digits, as tuned values are stored."""
    return float(f"{value:.6g}")


def read_table(place: Any) -> dict[str, dict[str, Any]]:
    """Read a file of tuned values; return its entries by policy, empty if there is no file."""
    try:
        table = read_json(place)
    except FileNotFoundError:
        return {}
    if not has_type(table, dict[str, dict[str, Any]]):
        raise ValueError(f"{place} is not a table of tuned policies: correct or remove it")
    return table


def save_tuned(outcome: Tuned, command: str, folder: Path = FOLDER) -> Path:
    """Write tuned values into the environment's file, whose other entries remain; return its path.

    Args:
        outcome: outcome of a search.
        command: command of the search.
        folder: folder of such files.

    Raises:
        ValueError: if the file cannot be written, or is not a table of tuned policies.
    """
    path = table_path(outcome.environment, folder)
    found = {
        "values": outcome.values,
        "scenario": outcome.scenario,
        "validation_cost": outcome.cost,
        "untuned_validation_cost": outcome.untuned_cost,
        "environment_steps": outcome.environment_steps,
        "seed": outcome.seed,
        "command": command,
    }
    with whole_file(path, PATIENCE) as partial:
        merged = {**read_table(path), outcome.policy: found}
        partial.write_text(json.dumps(merged, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return path


def table_path(id: str, folder: Path = FOLDER) -> Path:
    """Return the path of the file of an environment's tuned values in a folder."""
    return folder / f"{short_name(id)}.json"
