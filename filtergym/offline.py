"""Minari data sets of episodes of policies, for offline reinforcement learning.

A data set holds the episodes of one policy in one environment: observations, actions and rewards exactly as
``gymnasium.make`` gives them, and of every episode its seed. The environment can be made again from it.
"""

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy
from rich.table import Table

from . import __version__
from .agents.training_run import training_scenarios
from .baselines.problem import Problem, import_problem
from .envs.engine.catalogue import check_names
from .envs.engine.scenario_choice import find_scenario
from .evaluation.competitors.stepping import SteppingPolicy
from .evaluation.running.evaluate import Experiment
from .evaluation.running.rollout import Progress
from .evaluation.running.seeds import episode_seeds
from .evaluation.running.transitions import Transitions, transitions_of
from .evaluation.storage.files import whole_files
from .functions import find_policy
from .names import find_competitor
from .reports.tables.terminal_tables import plain_table

CHUNK = 256
"""Number of episodes that are simulated side by side, and stored in memory until they are written."""
RANDOM = "random"
ENVIRONMENT_KEYWORDS = ("reward", "dtype")
"""Keywords of ``gymnasium.make`` that are no parameters of the task, and change the agent's observation or reward."""


class DatasetSummary(NamedTuple):
    """Summary of a written data set: name, policy, environment, size and mean return."""

    name: str
    """Name for ``minari.load_dataset``."""
    policy: str
    environment: dict[str, Any]
    """Keywords of ``gymnasium.make``; data sets with equal ones can be combined."""
    episodes: int
    steps: int
    mean_return: float
    """Mean over the episodes of the sum of their rewards."""


def default_policies(problem: Problem, control: str | None = None) -> list[str]:
    """Return the names of the paper's policy, the tuned one of least cost, and random actions."""
    paper = problem.baselines.score_paper
    names = [paper, problem.tuned_values.best_policy(control), RANDOM]
    own = getattr(problem.competitor(paper), "control", None) if paper else None
    if own is not None and control not in (None, own):
        names.remove(paper)
    return list(dict.fromkeys(name for name in names if name))


def write_datasets(
    env: str,
    policies: Sequence[str | Path] | None = None,
    scenario: Any = None,
    control: str | None = None,
    episodes: int = 1000,
    seed: int = 0,
    split: str = "train",
    folder: Path | None = None,
    namespace: str | None = None,
    progress: Progress | None = None,
    *,
    trust: bool = False,
    **keywords: Any,
) -> list[DatasetSummary]:
    """Write the episodes of policies as Minari data sets, one for each policy, and return summaries.

    The environment of a policy is made with the policy's own control and parameters. One that has no
    control of its own, such as ``random``, acts in the environment of the policy named before it: these two data sets
    can be combined. All policies act in the same episodes. Where random actions are among the data sets of an
    environment, their mean return is its ``ref_min_score`` and the largest one its ``ref_max_score``.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        policies: names or paths, see :func:`.names.competitor`; default: :func:`default_policies`.
        scenario: of the environment; default: its training distribution.
        control: control of all policies.
        episodes: number of episodes in each data set.
        seed: number of the experiment.
        split: "train" (default), "validation" or "test"; held-out scenarios, and a user's flights, need "test".
        folder: folder of the data sets; default: that of Minari, ``MINARI_DATASETS_PATH`` or
            ``~/.minari/datasets``.
        namespace: beginning of the names; default: ``filtergym/maneuvering-target`` and the like.
        progress: function that is called repeatedly with the number of decisions done.
        trust: whether to load a model's zip, which can execute code.
        **keywords: parameters of the task; also ``reward`` and ``dtype`` of ``gymnasium.make``.

    Raises:
        ValueError: for unknown names, a competitor that does not act, a scenario that is held out, a data set that
            exists already, a folder that cannot be written to, or without Minari. Then nothing is written.
    """
    problem = import_problem(env)
    experiment = problem.experiment(scenario, episodes, seed, split, control, keywords=keywords)
    return plan_datasets(problem, experiment, policies, trust).write(folder, namespace, progress)


class DatasetPlan(NamedTuple):
    """Checked plan of data sets, whose writing raises errors of the folder only."""

    experiment: Experiment
    """Experiment of the episodes."""
    seeds: list[int]
    """Seeds of the episodes."""
    policies: list[SteppingPolicy]
    """Policies, one for each data set."""
    names: list[str]
    """Names of the policies."""
    environment_keywords: dict[str, Any]
    """Keywords of ``gymnasium.make`` beside those of the policies."""

    @property
    def decisions(self) -> int:
        """Number of decisions (actions) in all data sets."""
        tasks = [policy.model.task for policy in self.policies]
        return len(self.seeds) * sum(task.horizon // task.decision_interval for task in tasks)

    def write(
        self, folder: Path | None = None, namespace: str | None = None, progress: Progress | None = None
    ) -> list[DatasetSummary]:
        """Write the planned data sets; arguments, result and errors as of :func:`write_datasets`."""
        from minari.storage import get_dataset_path

        root = Path(folder) if folder is not None else get_dataset_path()
        names = _names(self.experiment.task.id, self.names, namespace, root)
        with whole_files(root) as waiting, _datasets_in(waiting):
            found = [self._write_one(i, name, progress or (lambda _: None)) for i, name in enumerate(names)]
            written = [entry for entry, _ in found]
            _store_scores(written, [dataset for _, dataset in found])
            for space in waiting.rglob("namespace_metadata.json"):
                if (root / space.relative_to(waiting)).exists():  # it may say what the user has written there
                    space.unlink()
        return written

    def _write_one(self, i: int, name: str, progress: Progress) -> tuple[DatasetSummary, Any]:
        """Write the data set of policy ``i``; return its summary, and the Minari data set."""
        policy, stepping, id = self.names[i], self.policies[i], self.experiment.task.id
        made_with = {**stepping.keywords, **self.environment_keywords}
        dataset: Any = None
        returns: list[float] = []
        for first in range(0, len(self.seeds), CHUNK):
            seeds = self.seeds[first : first + CHUNK]
            part = transitions_of(id, stepping, seeds, progress, **self.environment_keywords)
            returns += [float(episode.rewards.sum()) for episode in part]
            if dataset is None:
                about = self._description(policy, stepping.control)
                dataset = _create(name, part, gymnasium.make(id, **made_with), policy, about)
            else:
                dataset.update_dataset_from_buffer(_buffers(part))
        mean = sum(returns) / len(returns)
        return DatasetSummary(name, policy, made_with, len(returns), dataset.total_steps, mean), dataset

    def _description(self, policy: str, control: str) -> str:
        asked = self.experiment
        return (
            f"{asked.episodes} episodes of policy {policy}, control {control}, scenario "
            f"{find_scenario(asked.task, asked.scenario).name}, {asked.split} split, seed {asked.seed}; filtergym "
            f"{__version__}"
        )


def plan_datasets(
    problem: Problem,
    experiment: Experiment,
    policies: Sequence[str | Path] | None = None,
    trust: bool = False,
) -> DatasetPlan:
    """Check all arguments of a request for data sets, and return the plan to write them.

    Errors are those of :func:`write_datasets`.
    """
    try:
        import h5py  # noqa: F401  (Minari reports that it is missing only when it writes)
        import minari.storage  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f"Minari data sets need more packages: pip install 'filtergym[offline]' ({error})"
        ) from error
    cls, scenario, control = experiment.task, experiment.scenario, experiment.control
    seeds = episode_seeds(experiment.split, experiment.seed, experiment.episodes)
    if experiment.split != "test":
        try:
            training_scenarios(cls, cls.default_scenario if scenario is None else scenario)
        except ValueError as error:
            raise ValueError(f"{error}, or take the split test for evaluation data") from error
    parameters = dict(experiment.keywords)
    environment_keywords = {name: parameters.pop(name) for name in ENVIRONMENT_KEYWORDS if name in parameters}
    check_names(cls, parameters, ENVIRONMENT_KEYWORDS)
    chosen = list(policies or default_policies(problem, control))
    acting: list[SteppingPolicy] = []
    for policy in chosen:
        before = (
            acting[-1] if acting and _has_any_control(find_competitor(problem, policy, trust).maker) else None
        )
        own = before.control if before is not None and control is None else control
        theirs = {} if before is None else before.task_keywords
        fitting = replace(experiment, control=own, keywords={**theirs, **parameters})
        acting.append(find_policy(problem, policy, fitting, trust))
    return DatasetPlan(experiment, seeds, acting, [str(policy) for policy in chosen], environment_keywords)


def _has_any_control(maker: Any) -> bool:
    """Return whether a policy declares neither control nor action space, and so can act in any control."""
    return getattr(maker, "control", None) is None and getattr(maker, "action_space", None) is None


def _names(id: str, policies: Sequence[str], namespace: str | None, root: Path) -> list[str]:
    """Return the name of each policy's data set, such as ``filtergym/maneuvering-target/imm-v0``.

    Raises:
        ValueError: for an invalid namespace, and if a data set has one of the names.
    """
    from minari.dataset.minari_dataset import parse_dataset_id

    owner, _, title = id.partition("/")
    title, _, version = title.rpartition("-v")
    if namespace is None:
        namespace = f"{owner}/{_minari_name(re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '-', title).lower())}"
    names = [f"{namespace}/{_minari_name(policy)}-v{version}" for policy in policies]
    for i, name in enumerate(names):
        parse_dataset_id(name)
        if name in names[:i]:
            raise ValueError(f"two policies make data sets of the name {name!r}: write them one by one")
        if (root / name).exists():
            raise ValueError(
                f"data set {name!r} is in {root} already: remove it, or choose another namespace"
            )
    return names


def _minari_name(text: str) -> str:
    return re.sub(r"[^\w-]+", "-", text).strip("-")


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Set the folder in which Minari stores data sets, inside a ``with`` block."""
    variable = "MINARI_DATASETS_PATH"
    before = os.environ.get(variable)
    os.environ[variable] = str(folder.absolute())
    try:
        yield
    finally:
        if before is None:
            del os.environ[variable]
        else:
            os.environ[variable] = before


def _buffers(episodes: Sequence[Transitions]) -> list[Any]:
    from minari.data_collector import EpisodeBuffer

    return [
        EpisodeBuffer(
            seed=episode.seed,
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=numpy.zeros_like(episode.truncations),
            truncations=episode.truncations,
        )
        for episode in episodes
    ]


def _create(name: str, episodes: Sequence[Transitions], env: Any, policy: str, about: str) -> Any:
    """Return a new Minari data set that contains the given episodes."""
    import minari

    with warnings.catch_warnings():
        # Minari warns without an author's address and a link to code, which simulated data do not need.
        warnings.filterwarnings("ignore", r"`(author_email|code_permalink)` is set to None", UserWarning)
        return minari.create_dataset_from_buffers(
            name,
            _buffers(episodes),
            env=env,
            eval_env=env,
            algorithm_name=policy,
            author="filtergym",
            description=about,
            requirements=[f"filtergym>={__version__}"],
            data_format="hdf5",
        )


def _store_scores(written: Sequence[DatasetSummary], stored: Sequence[Any]) -> None:
    """Store in each data set the mean returns that ``minari.get_normalized_score`` maps to 0 and 1."""
    for entry, dataset in zip(written, stored, strict=True):
        alike = [other for other in written if other.environment == entry.environment]
        low = next((other.mean_return for other in alike if other.policy == RANDOM), None)
        high = max(other.mean_return for other in alike)
        if low is not None and low < high:
            scores = {"ref_min_score": low, "ref_max_score": high}
            dataset.storage.update_metadata({**scores, "num_episodes_average_score": entry.episodes})


def datasets_table(summaries: Iterable[DatasetSummary]) -> Table:
    """Return a table of written data sets for the terminal: environment, size and mean return."""
    table = plain_table()
    table.add_column("data set", overflow="fold")
    table.add_column("environment", overflow="fold")
    for title in ("episodes", "steps", "mean return"):
        table.add_column(title, justify="right")
    for entry in summaries:
        made_with = ", ".join(f"{name}={value}" for name, value in entry.environment.items())
        table.add_row(
            entry.name, made_with, f"{entry.episodes:,}", f"{entry.steps:,}", f"{entry.mean_return:.4g}"
        )
    return table
