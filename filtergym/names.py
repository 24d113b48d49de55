"""Every name that a user gives, and what it stands for: the one place where names become objects."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import xarray

from .agents.gate import GatedMaker
from .agents.named_policies import find_learned_policy, pretrained_agents, with_normalisation
from .baselines.fitted_filters import SUFFIX, LogSetup, read_artefact
from .baselines.problem import Problem, import_problem, problem_of
from .envs.contract.model import Model
from .envs.contract.parameters import quote_shortened
from .envs.data.recording import Recording
from .envs.engine.backend import make_model
from .envs.engine.catalogue import import_task, import_user_module, nearest
from .envs.interface.environment import TaskEnv
from .envs.interface.vector_environment import TaskVectorEnv
from .evaluation.competitors.file_estimates import FileEstimates
from .evaluation.competitors.isolation import ISOLATED, isolate_estimator
from .evaluation.competitors.kinds import check_competitor, kind_of, make_competitor
from .evaluation.competitors.programs import EXEC, Program
from .evaluation.competitors.stepping import SteppingPolicy
from .evaluation.running import metrics
from .evaluation.running.evaluate import Experiment, check_observation, control_of
from .evaluation.running.metrics import Record
from .evaluation.running.recording import record_experiment
from .evaluation.running.rollout import Progress
from .evaluation.running.summary import EvaluationRequest

GATED = "gated:"
"""Before the name of a policy: the policy behind a gate, see :mod:`.agents.gate`."""
FILE = "file:"
"""Before a path: estimates that another program has made, see :mod:`.evaluation.competitors.file_estimates`."""


def competitor(env: str, name: str | Path, *, trust: bool = False) -> Any:
    """Return what makes a policy, estimator, reference or bound.

    Args:
        env: environment id.
        name: one of the environment's own, ``NAME-tuned``, a shipped agent, a file (``.safetensors``, or the
            ``.zip`` of a Stable-Baselines3 model), the folder of a training run, ``module:Class`` of a user's,
            ``isolated:module:Class`` of an estimator in a process of its own, ``exec:COMMAND`` of any program, or
            ``gated:NAME`` of a policy: an estimator that answers with that one's filter while it is trusted, else with
            a classical filter, or ``file:PATH`` of estimates that another program has made. A path is that of a file or
            folder, whatever else has its name.
        trust: load a ``.zip``, which can execute code.

    Raises:
        ValueError: if there is no such name, what it names is no competitor, or it takes ``trust``.
    """
    return find_competitor(import_problem(env), name, trust)


def find_competitor(problem: Problem, name: str | Path, trust: bool = False) -> Any:
    """Return what a name stands for in a problem; names and refusals as of :func:`competitor`."""
    if isinstance(name, str) and name.startswith(EXEC):
        return Program(name.removeprefix(EXEC))
    if isinstance(name, str) and name.startswith(ISOLATED):
        return isolate_estimator(name.removeprefix(ISOLATED))
    if isinstance(name, Path) and name.name.endswith(SUFFIX):
        return _find_advised(problem, name)
    if isinstance(name, Path):
        found = find_learned_policy(problem.task, str(name.absolute()), trust)
        if found is None:
            raise ValueError(
                f"cannot load policy {str(name)!r}: it is neither a .safetensors, a .zip, nor a folder"
            )
        return found
    if name.endswith(SUFFIX):
        return _find_advised(problem, Path(name))
    if name.startswith(FILE):
        return FileEstimates(Path(name.removeprefix(FILE)).absolute())
    if name.startswith(GATED):
        inner = name.removeprefix(GATED)
        return GatedMaker(problem, inner, find_competitor(problem, inner, trust))
    own = problem.find(name)
    if own is not None:
        return own
    learned = find_learned_policy(problem.task, name, trust)
    if learned is not None:
        return learned
    if name.endswith("-tuned"):
        return problem.competitor(name)  # refuses it
    module, colon, attribute = name.partition(":")
    if not colon:
        for ending in (".zip", ".safetensors", SUFFIX):
            # Stable-Baselines3 saves "mine" as mine.zip. Unlike a Path, this takes a name that no file can have.
            if os.path.isfile(f"{name}{ending}"):
                raise ValueError(f"unknown policy {name!r}: a file is named whole, {name}{ending}")
        raise nearest("policy", name, [*problem.names, *pretrained_agents(problem.id)])
    holder = import_user_module(module, f"cannot load policy {name!r}")
    if not hasattr(holder, attribute):
        raise ValueError(f"cannot load policy {name!r}: {holder} has no {attribute!r}")
    return check_competitor(name, getattr(holder, attribute))


def _find_advised(problem: Problem, path: Path) -> Any:
    """Return what makes the filter of a file of ``filtergym advise``: a fitted one, or one that is shipped."""
    found = read_artefact(path, problem)
    if found.fitted is not None:
        return found.fitted
    shipped = [*problem.names, *pretrained_agents(problem.id)]
    if found.filter not in shipped:
        raise nearest(f"shipped filter (named by {path})", found.filter, shipped)
    return find_competitor(problem, found.filter)


def find_log_setup(problem: Problem, name: Any) -> LogSetup | None:
    """Return how the log was read that the filter of a file was advised for; None for anything else."""
    if not (isinstance(name, str | Path) and str(name).endswith(SUFFIX)):
        return None
    return read_artefact(Path(name), problem).log


def assumed_parameters(env: str | None, names: Sequence[str]) -> dict[str, float]:
    """Return the parameters under which a log without deviations is read as the one of an advised filter was; of the
    first file among the names that says any.
    """
    for name in names:
        if env is not None and name.endswith(SUFFIX):
            log = find_log_setup(import_problem(env), name)
            if log is not None and log.assumed:
                return log.assumed
    return {}


def isolate_names(problem: Problem, names: Sequence[str]) -> list[str]:
    """Return names of competitors, where each ``module:Class`` is one in a process of its own.

    Raises:
        ValueError: for one behind a gate, which acts in this process.
    """

    def is_module(name: str) -> bool:
        return problem.find(name) is None and re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", name) is not None

    for name in names:
        if name.startswith(GATED) and is_module(name.removeprefix(GATED)):
            raise ValueError(f"{name!r} acts in this process, beside the truth: an estimator can be isolated")
    prefixes = (EXEC, FILE, ISOLATED, GATED)
    return [ISOLATED + name if is_module(name) and not name.startswith(prefixes) else name for name in names]


def is_learned(problem: Problem, name: str) -> bool:
    """Whether a name stands for something learned: a shipped agent, a file, or the folder of a training run."""
    inner = name.removeprefix(GATED)
    if problem.find(inner) is not None or inner.endswith(SUFFIX):
        return False
    return inner in pretrained_agents(problem.id) or ":" not in inner


def evaluate(
    env: str,
    competitors: str | Path | Sequence[str | Path] | Mapping[str, Any],
    scenario: Any = None,
    episodes: int = 500,
    seed: int = 0,
    split: str = "test",
    control: str | None = None,
    progress: Progress | None = None,
    *,
    trust: bool = False,
    **keywords: Any,
) -> xarray.Dataset:
    """Run policies, estimators, references and bounds over the same episodes.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        competitors: a name, names, or a mapping from a name to a name, a class, or an object: with a method ``predict``
            (:class:`.kinds.Policy`), or with ``start`` and ``update``
            (:class:`.kinds.Estimator`); see :func:`competitor` for what a name can be. A
            model of Stable-Baselines3 is shown observations as its ``VecNormalize`` normalises them, if it holds one.
        scenario: name of a scenario, path of flights or of a recording, or a trajectory; default: the environment's
            training distribution.
        episodes: Monte Carlo runs M.
        seed: number of the experiment.
        split: "test" (default), "validation" or "train"; splits share no episode.
        control: demand this control; by default every policy runs in its own.
        progress: called with the number of measurements done, now and then.
        trust: load models' zips, which can execute code.
        **keywords: parameters of the task; also ``backend``, ``threads``, ``tracks``, ``drawn_episodes``, ``strict``
            of :class:`.evaluate.Experiment`, and ``workers`` of :func:`.evaluate.run_experiment`.

    Returns:
        Errors, costs and records over the dimensions policy, episode and time; see
        :func:`.evaluate.run_experiment`. Costs are compared with the paper's algorithm where it is among the
        competitors, whatever it is called there.

    Raises:
        ValueError: for unknown names, a name of one's own that is taken, a policy that does not fit the control, or
            an estimator that does not answer with mean and covariance.
    """
    problem = import_problem(env)
    objects = competitors_of(problem, competitors, trust)
    return problem.evaluate(objects, scenario, episodes, seed, split, control, progress=progress, **keywords)


def record(
    env: str,
    scenario: Any = None,
    episodes: int = 10,
    seed: int = 0,
    split: str = "test",
    progress: Progress | None = None,
    *,
    backend: str = "auto",
    **keywords: Any,
) -> Recording:
    """Record what the sensors say in episodes of the simulation, and the truth.

    They are the episodes that an evaluation of the same scenario, seed and split flies. Replayed on the same backend,
    observations, estimates and costs are the same, bit for bit.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        scenario: name of a scenario, a trajectory, or flights; default: the environment's training distribution.
        episodes: how many.
        seed: number of the experiment.
        split: "test" (default), "validation" or "train".
        progress: called with the number of measurements done, now and then.
        backend: what computes the steps, "auto", "compiled" or "numpy".
        **keywords: parameters of the task.

    Raises:
        ValueError: for unknown names, a closed loop, or more measurements than a recording may hold.
    """
    task = import_task(env)
    return record_experiment(
        Experiment(task, scenario, episodes, seed, split, backend=backend, keywords=keywords), progress
    )


def competitors_of(
    problem: Problem,
    competitors: str | Path | Sequence[str | Path] | Mapping[str, Any],
    trust: bool = False,
) -> dict[str, Any]:
    """Return what makes each of some competitors, by their names; arguments and refusals as of :func:`evaluate`."""
    if isinstance(competitors, str | Path):
        competitors = [competitors]
    if not isinstance(competitors, Mapping | Sequence):
        raise ValueError(
            "competitors are a name, a sequence of names, or a mapping from names to policies, got "
            f"{quote_shortened(competitors)}"
        )
    named = competitors if isinstance(competitors, Mapping) else {str(name): name for name in competitors}
    for name, entry in named.items():
        if type(entry) is str and entry == name:
            continue
        known = problem.find(name)
        if known is not None or name in pretrained_agents(problem.id):
            known = find_competitor(problem, name) if known is None else known
            if type(entry) is not type(known) or not bool(entry == known):
                raise ValueError(
                    f"{name!r} is the name of what {problem.id} has already: call your own something else"
                )
    return {
        name: find_competitor(problem, entry, trust)
        if isinstance(entry, str | Path)
        else with_normalisation(entry)
        for name, entry in named.items()
    }


def evaluation_requests(
    problem: Problem,
    experiment: Experiment,
    competitors: str | Path | Sequence[str | Path] | Mapping[str, Any],
    trust: bool = False,
    curves: bool = True,
) -> list[EvaluationRequest]:
    """Return what :func:`.evaluation.running.summary.summaries` makes of an experiment, for each competitor.

    Args:
        problem: whose competitors these are.
        experiment: on it, as :meth:`.baselines.problem.Problem.experiment` makes it.
        competitors: as of :func:`evaluate`.
        trust: likewise.
        curves: whether figures will be drawn.

    Raises:
        ValueError: for unknown names.
    """
    makers = competitors_of(problem, competitors, trust)
    experiment = replace(experiment, paper=problem.paper_among(makers))
    own, horizon = problem.baselines.metrics, experiment.make_task().horizon
    return [
        EvaluationRequest(experiment, name, maker, own, horizon, curves=curves)
        for name, maker in makers.items()
    ]


def make_policy(
    env: Any,
    policy: Any,
    control: str | None = None,
    scenario: Any = None,
    *,
    trust: bool = False,
    **keywords: Any,
) -> SteppingPolicy:
    """Make a policy to step an environment with: the paper's, a tuned one, an agent, or one of your own.

    It has Stable-Baselines3's ``predict(observation, state, episode_start, deterministic)``, for one observation as for
    a batch, and does in a loop of your own what it does in an evaluation.

    Args:
        env: an environment, single or native vector, in which the policy acts; or the id of one, which is then made
            with ``gymnasium.make(id, **made.keywords)``.
        policy: a name or a path, see :func:`competitor`, or an object or a class as in :func:`evaluate`.
        control: for an id: demand this control; by default the policy's own.
        scenario: for an id: of the environment.
        trust: load a model's zip, which can execute code.
        **keywords: for an id: parameters of the task.

    Raises:
        ValueError: for unknown names, what is no policy, and a policy that does not fit the environment.
    """
    if isinstance(env, str):
        problem = import_problem(env)
        return find_policy(
            problem, policy, problem.experiment(scenario, control=control, keywords=keywords), trust
        )
    model = _model_of(env)
    problem = Problem.of(type(model.task))
    if control is not None or scenario is not None or keywords:
        raise ValueError("control, scenario and parameters are the environment's own: leave them out")
    name, maker = _named_policy(problem, policy, trust)
    control_of(maker, model.control, problem.task, name)
    keywords = getattr(maker, "task_keywords", {})
    for parameter, value in keywords.items():
        own = getattr(model.task.parameters, parameter)
        if own != value:
            raise ValueError(
                f"policy {name!r} acts in an environment with {parameter}={value!r}, and this one has {own!r}: "
                "make it by gymnasium.make(id, **filtergym.make_policy(id, policy).keywords)"
            )
    return _stepping(name, maker, model, None, keywords)


def find_policy(problem: Problem, policy: Any, experiment: Experiment, trust: bool = False) -> SteppingPolicy:
    """Make a policy to step the environment of an experiment with, and that environment's model.

    Args:
        problem: whose policy it is.
        policy: as of :func:`make_policy`, likewise what is refused.
        experiment: whose control, scenario and parameters the environment has.
        trust: likewise.
    """
    name, maker = _named_policy(problem, policy, trust)
    control = control_of(maker, experiment.control, problem.task, name)
    keywords = {**getattr(maker, "task_keywords", {}), **experiment.keywords}
    model = make_model(problem.task, control, experiment.scenario, backend=experiment.backend, **keywords)
    return _stepping(name, maker, model, experiment.scenario, keywords)


def _named_policy(problem: Problem, policy: Any, trust: bool) -> tuple[str, Any]:
    """Return the name of a policy in errors, and what makes it.

    Raises:
        ValueError: for what does not act.
    """
    if isinstance(policy, str | Path):
        name, maker = str(policy), find_competitor(problem, policy, trust)
    else:
        name, maker = type(policy).__name__, with_normalisation(policy)
    kind = kind_of(maker)
    if kind != "policy":
        raise ValueError(f"{name!r} does not act: of kind {kind}, it can be evaluated only")
    return name, maker


def _stepping(
    name: str, maker: Any, model: Model, scenario: Any, keywords: Mapping[str, Any]
) -> SteppingPolicy:
    check_observation(model, maker, name)
    policy = check_competitor(name, make_competitor(maker, model), "policy")
    return SteppingPolicy(model, policy, scenario, keywords)


def _model_of(env: Any) -> Any:
    """Return the model of an environment.

    Raises:
        ValueError: if it is none of filtergym, or computes in torch.
    """
    inner = env.unwrapped if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv) else env
    if not isinstance(inner, TaskEnv | TaskVectorEnv):
        raise ValueError(
            "make_policy takes the id of an environment, or one of filtergym made by gymnasium.make or make_vec, got "
            f"{type(inner).__name__}"
        )
    if inner.privileged:
        raise ValueError(
            "this environment shows what no policy may know: make it without observation='asymmetric', or show "
            "a policy of your own observation['observation']"
        )
    if inner.fleet.mixes_scenarios:
        raise ValueError(
            "a policy is made for the parameters of one scenario, and this environment flies several: make it with one"
        )
    if inner.backend == "torch":
        raise ValueError("policies answer in NumPy arrays: make the environment with another backend")
    return inner.model


def tidy_records(dataset: xarray.Dataset) -> list[Record]:
    """Return every metric of every policy with its interval, the environment's own among them.

    Args:
        dataset: from :func:`evaluate`; see :func:`.evaluation.running.metrics.tidy_records`.
    """
    return metrics.tidy_records(dataset, problem_of(dataset.attrs["environment"]).baselines.metrics)
