"""A user's settings of a training run, as options or in a file: those of the environment and of the algorithm.

Values are parsed as YAML. Later sources override earlier ones, key by key: the shipped hyperparameters, the user's
file, single settings.
"""

import inspect
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..envs.contract.task import Task
from ..envs.data.foreign_files import read_yaml
from ..envs.engine.catalogue import nearest, parameter_names

SCIENTIFIC = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+")
"""Numbers such as 1e-3, which YAML 1.1 parses as strings."""
OPTIONS = ("control", "scenario", "backend")
"""Keywords of an environment that are also options of a training run."""
SETTABLE = (*OPTIONS, "reward", "dtype")
"""Keywords of an environment, beside its parameters, that training accepts."""
ESTIMATORS = ("kalman-net", "student")
"""Algorithms that train a learned estimator: a network that acts in a filter of its own (:class:`.TrainedBanks`)."""
THROUGH_THE_FILTER = ("bptt", "bptt-linear", "bptt-small", "bptt-strongest", "ma-ukf", *ESTIMATORS)
"""Algorithms of :mod:`.bptt`."""
RIVALS = ("ma-ukf", "rl-ukf")
"""Algorithms of one control, that of their hyperparameters: of papers that train policies for it."""
RUN_ARGUMENTS = {"self", "env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
"""Arguments of an algorithm that a run sets itself."""


def convert_numbers(value: Any) -> Any:
    """Return a parsed YAML value in which texts such as ``1e-3`` have become numbers."""
    if isinstance(value, str) and SCIENTIFIC.fullmatch(value):
        return float(value)
    if isinstance(value, list):
        return [convert_numbers(item) for item in value]
    if isinstance(value, dict):
        return {name: convert_numbers(item) for name, item in value.items()}
    return value


def merge_settings(first: Mapping[str, Any], then: Mapping[str, Any]) -> dict[str, Any]:
    """Return two nested mappings merged; the second overrides the first."""
    both = dict(first)
    for name, value in then.items():
        own = both.get(name)
        both[name] = (
            merge_settings(own, value) if isinstance(own, Mapping) and isinstance(value, Mapping) else value
        )
    return both


def parse_settings(words: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parse words ``env.NAME=VALUE`` and ``algo.NAME=VALUE``; further dots are keys inside a mapping.

    Raises:
        ValueError: for another form.
    """
    import yaml

    found: dict[str, dict[str, Any]] = {"env": {}, "algo": {}}
    for word in words:
        path, equals, text = word.partition("=")
        kind, *names = path.strip().split(".")
        if not equals or kind not in found or not names or not all(names):
            raise ValueError(
                f"--set needs env.NAME=VALUE or algo.NAME=VALUE, such as --set algo.learning_rate=0.001, got {word!r}"
            )
        try:
            value = convert_numbers(yaml.safe_load(text))
        except yaml.YAMLError as error:
            raise ValueError(f"--set {path}: cannot read the value {text!r} as YAML") from error
        for name in reversed(names):
            value = {name: value}
        found[kind] = merge_settings(found[kind], value)
    return found["env"], found["algo"]


def _read_table(path: Path, needs: str) -> dict[str, Any]:
    """Return the mapping in a YAML file."""
    try:
        table = convert_numbers(read_yaml(path))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"cannot read settings from {path}: {reason}") from error
    if not isinstance(table, dict) or not table:
        raise ValueError(f"{path} needs {needs}")
    return table


def _section(table: Mapping[str, Any], path: Path, id: str) -> Any:
    """Return an environment's section of a table of settings, else ``default``; raise ValueError without both."""
    section = table.get(id, table.get("default"))
    if section is None:
        raise ValueError(
            f"{path} has no section {id} and none called default: it has {', '.join(map(str, table))}"
        )
    return section


def read_config(path: Path, id: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of an environment in a user's YAML file: its keywords, and hyperparameters.

    Args:
        path: YAML file with hyperparameters in sections by environment id or ``default``, as in rl-zoo3, with
            keywords of the environment in ``env_kwargs``; or with the keys ``env`` and ``algo``.
        id: environment id.

    Raises:
        ValueError: if the file cannot be read, is of another form, or has no section for the environment.
    """
    table = _read_table(path, "sections by environment id or default, or the keys env and algo")
    if table.keys() <= {"env", "algo"}:
        env, algo = table.get("env") or {}, table.get("algo") or {}
    else:
        section = _section(table, path, id)
        algo = dict(section) if isinstance(section, dict) else section
        env = (algo.pop("env_kwargs", None) or {}) if isinstance(algo, dict) else {}
    for what, part in (("environment", env), ("algorithm", algo)):
        if not isinstance(part, dict) or not all(isinstance(name, str) for name in part):
            raise ValueError(f"{path}: settings of the {what} map names to values, got {part!r}")
    return env, algo


def check_keywords(cls: type[Task], algorithm: str, keywords: Mapping[str, Any]) -> None:
    """Raise ValueError for a keyword of the environment that is unknown or that training does not accept."""
    known = [*parameter_names(cls), *SETTABLE]
    for name in keywords:
        if name not in known:
            raise nearest("setting", f"env.{name}", [f"env.{other}" for other in known])
    if algorithm in THROUGH_THE_FILTER and keywords.get("dtype", "float64") != "float64":
        raise ValueError(f"algorithm {algorithm!r} needs float64: leave out env.dtype")


def check_hyperparameters(algorithm: str, values: Mapping[str, Any], shipped: Mapping[str, Any]) -> None:
    """Raise ValueError for a hyperparameter that the algorithm does not have."""
    known = {"n_envs", "n_timesteps", *shipped}
    if algorithm in THROUGH_THE_FILTER:
        known |= {
            "action_penalty",
            "first_action",
            "fields_kept",
            "longest_memory",
            "max_action_grad",
            "network",
        }
        known |= {"teacher", "teacher_share"}
    else:
        from .sb3_algorithms import ALGORITHMS

        cls = ALGORITHMS[algorithm]
        known |= {"normalize", *inspect.signature(cls).parameters} - RUN_ARGUMENTS
        policy = cls.policy_aliases.get(str(values.get("policy")))
        own = values.get("policy_kwargs") or {}
        if not isinstance(own, Mapping):
            raise ValueError(f"policy_kwargs maps names to values, got {own!r}")
        if policy is not None:
            parameters = set(inspect.signature(policy).parameters) - {
                "observation_space",
                "action_space",
                "lr_schedule",
            }
            for name in own:
                if name not in parameters:
                    inside = "algo.policy_kwargs."
                    raise nearest("setting", inside + name, [inside + other for other in sorted(parameters)])
        elif "policy" in values:
            raise nearest("policy", values["policy"], cls.policy_aliases)
    for name in values:
        if name not in known:
            raise nearest(
                "setting", f"algo.{name}", [f"algo.{other}" for other in sorted(known - {"env_kwargs"})]
            )
