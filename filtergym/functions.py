"""Functions of the package: evaluate, record, and make a policy for a user's own loop."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import xarray

from .baselines.problem import Problem, import_problem, problem_of
from .envs.contract.model import Model
from .envs.data.recording import Recording
from .envs.engine.backend import make_model
from .envs.engine.catalogue import import_task
from .envs.interface.environment import TaskEnv
from .envs.interface.vector_environment import TaskVectorEnv
from .evaluation.competitors.kinds import Competitor, check_competitor, kind_of, make_competitor
from .evaluation.competitors.stepping import SteppingPolicy
from .evaluation.running import metrics
from .evaluation.running.evaluate import Experiment, check_observation, control_of
from .evaluation.running.metrics import Record
from .evaluation.running.recording import record_experiment
from .evaluation.running.rollout import Progress
from .evaluation.running.summary import EvaluationRequest
from .names import adopt, find_competitor, find_competitors


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
    """Run policies, estimators, references and bounds over the same episodes, and return costs and errors.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        competitors: a name, names, or a mapping from a name to a name, a class, or an object: with a method ``predict``
            (:class:`.kinds.Policy`), or with ``start`` and ``update``
            (:class:`.kinds.Estimator`); see :func:`.names.competitor` for what a name can be. A
            model of Stable-Baselines3 observes what its ``VecNormalize`` normalises, if it contains one.
        scenario: name of a scenario, path of flights or of a recording, or a trajectory; default: the environment's
            training distribution.
        episodes: Monte Carlo runs M.
        seed: number of the experiment.
        split: "test" (default), "validation" or "train"; splits share no episode.
        control: control of all policies; by default every policy runs in its own.
        progress: function that is called repeatedly with the number of measurements done.
        trust: whether to load models' zips, which can execute code.
        **keywords: parameters of the task; also ``backend``, ``threads``, ``tracks``, ``drawn_episodes``, ``strict``
            of :class:`.evaluate.Experiment`, and ``workers`` of :func:`.evaluate.run_experiment`.

    Returns:
        Errors, costs and records over the dimensions policy, episode and time; see
        :func:`.evaluate.run_experiment`. Costs are compared with the paper's algorithm where it is among the
        competitors, under any name.

    Raises:
        ValueError: for unknown names, a user's name that is taken, a policy that does not fit the control, or an
            estimator that does not return mean and covariance.
    """
    problem = import_problem(env)
    makers = {found.name: found.maker for found in find_competitors(problem, competitors, trust)}
    return problem.evaluate(makers, scenario, episodes, seed, split, control, progress=progress, **keywords)


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
    """Simulate episodes, and return their measurements and truth as a recording.

    They are the episodes of an evaluation with the same scenario, seed and split. Replayed on the same backend,
    observations, estimates and costs are the same, bit for bit.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        scenario: name of a scenario, a trajectory, or flights; default: the environment's training distribution.
        episodes: number of episodes.
        seed: number of the experiment.
        split: "test" (default), "validation" or "train".
        progress: function that is called repeatedly with the number of measurements done.
        backend: implementation of the steps, "auto", "compiled" or "numpy".
        **keywords: parameters of the task.

    Raises:
        ValueError: for unknown names, a closed loop, or more measurements than a recording may contain.
    """
    task = import_task(env)
    return record_experiment(
        Experiment(task, scenario, episodes, seed, split, backend=backend, keywords=keywords), progress
    )


def requests_of(
    problem: Problem, experiment: Experiment, competitors: Sequence[Competitor], curves: bool = True
) -> list[EvaluationRequest]:
    """Return the evaluation request of each competitor in an experiment, compared with the paper's algorithm."""
    paper = problem.paper_among({one.name: one.maker for one in competitors})
    experiment = replace(experiment, paper=paper)
    own, horizon = problem.baselines.metrics, experiment.make_task().horizon
    return [
        EvaluationRequest(experiment, one.name, one.maker, own, horizon, curves=curves, identity=one.identity)
        for one in competitors
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
    """Return a policy that acts in an environment: the paper's, a tuned one, an agent, or one of your own.

    It has Stable-Baselines3's ``predict(observation, state, episode_start, deterministic)``, for one observation as for
    a batch, and acts in a loop of your own as in an evaluation.

    Args:
        env: an environment, single or native vector, in which the policy acts; or the id of one, which is then made
            with ``gymnasium.make(id, **made.keywords)``.
        policy: a name or a path, see :func:`.names.competitor`, or an object or a class as in :func:`evaluate`.
        control: for an id: the control; by default the policy's own.
        scenario: for an id: name of the scenario.
        trust: whether to load a model's zip, which can execute code.
        **keywords: for an id: parameters of the task.

    Raises:
        ValueError: for unknown names, an object that is no policy, and a policy that does not fit the environment.
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
    """Return a policy that acts in the environment of an experiment; its model is that environment's.

    Errors are those of :func:`make_policy`.
    """
    name, maker = _named_policy(problem, policy, trust)
    control = control_of(maker, experiment.control, problem.task, name)
    keywords = {**getattr(maker, "task_keywords", {}), **experiment.keywords}
    model = make_model(problem.task, control, experiment.scenario, backend=experiment.backend, **keywords)
    return _stepping(name, maker, model, experiment.scenario, keywords)


def _named_policy(problem: Problem, policy: Any, trust: bool) -> tuple[str, Any]:
    """Return the name of a policy in errors, and its factory."""
    if isinstance(policy, str | Path):
        name, maker = str(policy), find_competitor(problem, policy, trust).maker
    else:
        name, maker = type(policy).__name__, adopt(policy)
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
    """Return the model inside a Gymnasium environment of this package.

    Raises:
        ValueError: if it is none of filtergym, shows the truth, mixes scenarios, or computes in torch.
    """
    inner = env.unwrapped if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv) else env
    if not isinstance(inner, TaskEnv | TaskVectorEnv):
        raise ValueError(
            "make_policy takes the id of an environment, or one of filtergym made by gymnasium.make or make_vec, got "
            f"{type(inner).__name__}"
        )
    if inner.privileged:
        raise ValueError(
            "this environment shows the truth, which a policy may not observe: make it without "
            "observation='asymmetric', or show a policy of your own observation['observation']"
        )
    if inner.fleet.mixes_scenarios:
        raise ValueError(
            "a policy is made for the parameters of one scenario, and this environment has several: make it with one"
        )
    if inner.backend == "torch":
        raise ValueError("policies return NumPy arrays: make the environment with another backend")
    return inner.model


def tidy_records(dataset: xarray.Dataset) -> list[Record]:
    """Return a record of every metric of every policy, with its interval, the environment's metrics included.

    Args:
        dataset: from :func:`evaluate`; see :func:`.evaluation.running.metrics.tidy_records`.
    """
    return metrics.tidy_records(dataset, problem_of(dataset.attrs["environment"]).baselines.metrics)
