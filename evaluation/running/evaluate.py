"""Monte Carlo evaluation of policies, estimators, smoothers, references and bounds on identical noise.

The result is an :class:`xarray.Dataset` from which every number and figure follows; see :func:`run_experiment`.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import cloudpickle
import gymnasium
import numpy

from ...compiler.native import optimised_code
from ...envs.contract.companions import lost_cost
from ...envs.contract.model import Model
from ...envs.contract.parameters import check_integer, quote_shortened
from ...envs.contract.task import Scenario, Task
from ...envs.engine.backend import make_model
from ...envs.engine.catalogue import importable_name, nearest, task_class
from ...envs.engine.episode_noise import uniforms_of_seeds
from ...envs.engine.programs import Report
from ...envs.engine.scenario_choice import find_scenario, make_task, read_files
from ..competitors.kinds import INFORMED_KINDS, Kind, kind_of
from ..competitors.smoothers import check_open_loop
from ..statistics.bootstrap import block_of
from ..statistics.innovations import with_innovations
from ..statistics.time_blocks import BlockBootstrap
from ..storage.dataset import FAULTS, keywords_as_text, whole_number
from .metrics import bootstrap_of, time_units_of
from .named_axes import StackedArrays, recording_coords, with_named_axes
from .parallel import Workers, check_workers
from .rollout import Progress, measure_time, run_episodes
from .seeds import episode_seeds
from .stored_values import StoredValues, bound_values
from .supervision import report_running
from .threads import one_thread
from .times import ProcessorTime, with_times

if TYPE_CHECKING:
    import xarray


def control_of(maker: Any, control: str | None, cls: type[Task], name: str) -> str:
    """Return the control in which a competitor runs: its own, one whose spaces fit a learned model, or the
    first.

    Args:
        maker: maker of the competitor, or the competitor itself.
        control: required control; None: any.
        cls: task class of the environment.
        name: name of the competitor, for error messages.

    Raises:
        ValueError: if the competitor cannot act in the required control, or in any.
    """
    if control is not None and not isinstance(control, str):  # an array has no truth value
        raise nearest("control", control, cls.controls)
    if kind_of(maker) != "policy":
        return cls.controls[0]
    own = getattr(maker, "control", None)
    space = getattr(maker, "action_space", None)
    if own is None and space is not None:
        models = [make_model(cls, c) for c in cls.controls]
        acting = [model for model in models if model.action_space == space]
        if not acting:
            raise ValueError(
                f"policy {name!r} acts in {space}, which is the action space of no control of {cls.id}"
            )
        # Controls may share an action space; their observation spaces then distinguish them.
        shown = getattr(getattr(maker, "observation_space", None), "shape", None)
        fitting = [t.control for t in acting if (len(t.fields),) == shown] or [t.control for t in acting]
        own = control if control in fitting else fitting[0]
    if own is None:
        return control or cls.controls[0]
    if control is not None and own != control:
        raise ValueError(f"policy {name!r} is made for control {own!r}, not {control!r}")
    return own


def check_observation(model: Model, policy: Any, name: str) -> None:
    """Raise ValueError if a learned policy expects observations of another shape, or privileged ones (truth)."""
    space = getattr(policy, "observation_space", None)
    if isinstance(space, gymnasium.spaces.Dict):
        raise ValueError(
            f"policy {name!r} takes privileged observations ({', '.join(space)}), which no evaluation provides: wrap "
            "its actor, which needs the observations alone, in an object with a method predict"
        )
    shown = getattr(space, "shape", None)
    if shown is not None and shown != (len(model.fields),):
        raise ValueError(
            f"policy {name!r} expects observations of shape {shown}, but control {model.control!r} has "
            f"{len(model.fields)} fields, and a model does not contain their names: train it again, or give the "
            ".safetensors of its run, which does"
        )


OPTIONS = (
    "scenario", "episodes", "seed", "split", "control", "tracks", "drawn_episodes", "backend", "threads", "strict",
    "timed",
)  # fmt: skip
"""Names of the fields of an experiment that a user can give as keywords, together with parameters of the task."""


@dataclass(frozen=True)
class Experiment:
    """Environment, episodes and options of an evaluation, as plain data for any process."""

    task: type[Task]
    """Class of the environment's task."""
    scenario: Any = None
    """Name of a scenario, a trajectory, a set of flights, or a recording; None: the training distribution."""
    episodes: int = 500
    """Number of Monte Carlo runs M; for a set of flights rounded up to the same number for each. A recording is
    replayed once, independent of it.
    """
    seed: int = 0
    """Seed of the experiment."""
    split: str = "test"
    """One of "test", "validation" and "train", which have no episode in common."""
    control: str | None = None
    """Name of the control in which all policies run; None: every policy runs in its own."""
    tracks: bool = False
    """Whether to store the data for plots of tracks, see :meth:`.Model.track`; they need memory."""
    drawn_episodes: int = 0
    """Number of first episodes with data for pictures, :meth:`.Model.picture_track`: variables ``drawn_estimate``
    and so on, over policy, drawn_episode and time.
    """
    paper: str = ""
    """Name of the paper's algorithm, whose score is 0; stored in the attributes of the evaluation."""
    reference: str = ""
    """Name of the competitor whose score is 1; stored in the attributes of the evaluation."""
    backend: str = "auto"
    """Backend of the steps, "auto", "compiled" or "numpy"; see :func:`.engine.backend.make_model`."""
    threads: int = 1
    """Number of threads that share the episodes, with the compiled backend."""
    strict: bool = False
    """Whether to raise an error where an estimator would lose an episode, see :class:`.filters.CheckedFilter`."""
    timed: bool = False
    """Whether to measure the processor time of every competitor, as coordinates ``nanoseconds`` and ``compiled``: the
    only results that differ from run to run.
    """
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the task by name."""

    def __reduce__(self) -> tuple[Any, ...]:
        others = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "task"}
        return _experiment_on, (importable_name(self.task), others)

    def make_task(self) -> Task:
        """Make the environment's task, with the scenario and the parameters."""
        return make_task(self.task, self.scenario, **self.keywords)

    def make_model(self, maker: Any, control: str) -> Model:
        """Make the model (task, bank and control) in which a competitor runs."""
        keywords = {**getattr(maker, "task_keywords", {}), **self.keywords}
        return make_model(
            self.task, control, self.scenario, backend=self.backend, threads=self.threads, **keywords
        )


def _experiment_on(name: str, others: Mapping[str, Any]) -> Experiment:
    """Make an experiment on the environment of this name, when it is unpickled."""
    return Experiment(task_class(name), **others)


@one_thread()
def run_experiment(
    experiment: Experiment,
    competitors: Mapping[str, Any],
    progress: Progress | None = None,
    workers: Workers | None = None,
) -> "xarray.Dataset":
    """Run policies, estimators, references and bounds over the same episodes; return a dataset of all values.

    Args:
        experiment: the episodes and options.
        competitors: by the name in the tables: each a class or function that makes it, or an object, with a method
            ``predict`` or, of an estimator, with ``start`` and ``update``; of a smoother with ``smooth``, too.
        progress: called with the number of measurements done, now and then.
        workers: processes for competitors and chunks of episodes; default: this process, one after the other.

    Returns:
        Variables over the dimensions policy, episode and time: ``error`` (also over component; estimate minus
        truth), ``cost``, ``compressed_cost`` (minus the ``cost`` reward), ``nees``, everything that the task records
        (``nis``, ``mode_probability``), ``mean_square`` of bounds, ``action`` (also over action_name) of policies whose
        action is a box, and ``lost`` of estimators, zero, or once an episode is lost the number of the reason, see
        :data:`.dataset.FAULTS`. Coordinates: ``unit`` and ``group`` of every component, ``kind`` and ``control`` of
        every policy, ``episode_seed`` (as text: some file formats have no such large numbers), ``nanoseconds`` and
        ``compiled`` of every policy where the experiment is timed, ``window_first`` and ``window_last`` of every
        window, and ``elapsed``, seconds since the start of the track, where measurements come regularly. For a set of
        flights ``flight`` and ``length`` give the flight of each episode and its number of measurements; later values
        are NaN. The attribute ``notes`` lists omissions. For a recording ``flight`` names the episode of the recording.
        Without truth there are neither ``error``, ``cost``, ``compressed_cost`` nor ``nees``. Where the truth of some
        components is unknown, their errors are NaN, ``nees`` and ``nees_degrees`` are those of the other components,
        and ``truth_known`` marks these.

    Raises:
        ValueError: for an unknown scenario, control or keyword, or a policy that does not fit
            the control.
    """
    dataset = run_competitors(experiment, competitors, progress, workers)
    if time_units_of(dataset) is not None and isinstance(
        bootstrap := bootstrap_of(dataset, 0), BlockBootstrap
    ):
        dataset.attrs["notes"] = "\n".join(filter(None, [dataset.attrs["notes"], bootstrap.sentence]))
    return dataset


def run_competitors(
    experiment: Experiment,
    competitors: Mapping[str, Any],
    progress: Progress | None = None,
    workers: Workers | None = None,
) -> "xarray.Dataset":
    """Run competitors as :func:`run_experiment`, without its note on intervals of a single episode."""
    if progress is not None and not callable(progress):
        raise ValueError(
            f"progress must be a function of the number of measurements done, got {quote_shortened(progress)}"
        )
    plan = plan_of(experiment, competitors)
    workers = check_workers(workers)
    block = block_of(next(iter(plan.models.values())).task.horizon)
    pieces = [
        plan.piece(name, first, block, workers.alone)
        for name in competitors
        for first in range(0, len(plan.seeds), block)
    ]
    if not workers.alone:
        check_sendable(experiment.task, competitors)
    sizes = [len(piece.seeds) * piece.horizon for piece in pieces]
    kept = plan.arrays(len(plan.seeds), experiment.drawn_episodes)
    for i, found in workers.run(run_piece, pieces, sizes, progress):
        kept.write(pieces[i].name, pieces[i].part, found)
    dataset = plan.dataset(kept, plan.seeds)
    if experiment.timed:
        return with_times(dataset, [plan.time(name) for name in competitors])
    return dataset


class Piece(NamedTuple):
    """Some episodes of one competitor as a unit of parallel work, which another process can run."""

    experiment: Experiment
    name: str
    maker: Any
    kind: Kind
    control: str
    seeds: list[int]
    first: int
    """Number of the first episode."""
    horizon: int
    model: Model | None
    """Model, if it already exists in this process."""

    @property
    def part(self) -> slice:
        """Slice of these episodes among all episodes of the evaluation."""
        return slice(self.first, self.first + len(self.seeds))


LIKELIHOOD = ("log_likelihood", "nis", "nis_degrees")
"""Names of the likelihood statistics, which only some estimators and references return."""


def run_piece(piece: Piece, tick: Progress) -> dict[str, numpy.ndarray]:
    """Run some episodes of one competitor; return the values at all measurements by name,
    ``(episodes, time, ...)``.
    """
    experiment, kind = piece.experiment, piece.kind
    model = piece.model or experiment.make_model(piece.maker, piece.control)
    kept, drawn = StoredValues(experiment.tracks), None
    report: Report = bound_values if kind == "bound" else kept
    if kind != "bound" and experiment.drawn_episodes > piece.first:
        most = experiment.drawn_episodes - piece.first
        drawn = replace(kept, drawings=True), most
    # Code that is timed afterwards is optimised here: so nothing is compiled in two ways.
    with (
        optimised_code() if experiment.timed else nullcontext(),
        report_running(piece.name, tick) as report_progress,
    ):
        result = run_episodes(
            model, piece.maker, kind, piece.seeds, report, piece.name, report_progress, drawn
        )
    arrays = dict(result.found)
    if kind == "policy":
        _check_reserved(model, arrays)
    if experiment.strict and "lost" in arrays and arrays["lost"].any():
        lost = arrays["lost"] > 0.0
        k = int(numpy.argmax(lost.any(axis=0)))
        i = int(numpy.argmax(lost[:, k]))
        reason = FAULTS[int(arrays["lost"][i, k]) - 1]
        raise ValueError(
            f"estimator {piece.name!r}: {reason} in episode {piece.first + i} at measurement {k + 1}"
        )
    if result.action is not None and isinstance(model.action_space, gymnasium.spaces.Box):
        box, action = model.action_space, numpy.asarray(result.action, dtype=numpy.float64)
        arrays["action"] = numpy.clip(action, box.low, box.high).reshape(*action.shape[:2], -1)
    if kind in ("estimator", "smoother", "reference"):
        for name in LIKELIHOOD:
            if name in arrays and numpy.isnan(arrays[name]).all():
                del arrays[name]
    return arrays


def _check_reserved(model: Model, found: Mapping[str, Any]) -> None:
    """Raise ValueError if a task records a value under a reserved name, ``action`` or ``lost``."""
    for taken in {"action", "lost"} & found.keys():
        raise ValueError(
            f"{model.task.id} records a value named {taken!r}, a name that an evaluation uses for "
            "applied actions or lost episodes: choose another name"
        )


class Plan(NamedTuple):
    """Prepared evaluation with checked arguments: its episodes, and the model of every competitor."""

    experiment: Experiment
    """The experiment; its scenario is read from files."""
    competitors: Mapping[str, Any]
    kinds: dict[str, Kind]
    models: dict[str, Model]
    scenario: Scenario
    seeds: list[int]
    """Seeds of the planned episodes."""
    first: int
    """Number of the first planned episode."""
    flight_numbers: numpy.ndarray | None
    """Number of the flight of each episode."""
    lengths: numpy.ndarray | None

    def piece(self, name: str, first: int, count: int, here: bool) -> Piece:
        """Return some episodes of a competitor as a unit of work; ``here``: with its model, for this process."""
        model = self.models[name]
        return Piece(
            self.experiment,
            name,
            self.competitors[name],
            self.kinds[name],
            model.control,
            self.seeds[first - self.first : first - self.first + count],
            first,
            model.task.horizon,
            model if here else None,
        )

    def time(self, name: str) -> ProcessorTime | None:
        """Measure a competitor's processor time for a measurement; None where :func:`.rollout.measure_time`
        gives none.
        """
        with report_running(name, timed=False):
            return measure_time(self.models[name], self.competitors[name], self.kinds[name], self.seeds, name)

    def arrays(self, episodes: int, drawn: int) -> StackedArrays:
        """Return preallocated arrays for all competitors' values in some episodes."""
        acting = [
            name
            for name, model in self.models.items()
            if self.kinds[name] == "policy" and isinstance(model.action_space, gymnasium.spaces.Box)
        ]
        return StackedArrays(self.models, acting, episodes, drawn)

    def dataset(self, arrays: StackedArrays, seeds: Sequence[int]) -> "xarray.Dataset":
        """Return the dataset of an evaluation from its arrays and the seeds of the episodes."""
        experiment = self.experiment
        dataset = with_named_axes(arrays, self.kinds, self.models, self.scenario.windows, seeds)
        if self.flight_numbers is not None and self.lengths is not None:
            beyond = dataset["time"].values > self.lengths[:, None]
            for values in dataset.data_vars.values() if beyond.any() else ():
                values.values[:, beyond[: values.shape[1]]] = numpy.nan
            dataset = dataset.assign_coords(
                flight=("episode", [self.scenario.flights[i] for i in self.flight_numbers]),
                length=("episode", self.lengths),
            )
            if self.scenario.recording is not None:
                dataset = dataset.assign_coords(
                    recording_coords(self.scenario.recording, self.flight_numbers, dataset)
                )
                dataset = with_innovations(dataset, next(iter(self.models.values())).task)
        task = next(iter(self.models.values())).task
        return dataset.assign_attrs(
            environment=task.id,
            scenario=self.scenario.name,
            keywords=keywords_as_text(experiment.keywords),
            split=experiment.split,
            seed=whole_number(experiment.seed),
            cost=task.reward.cost,
            paper=experiment.paper,
            reference=experiment.reference,
            notes="\n".join(self.scenario.notes),
            recorded=int(self.scenario.recording is not None),
            truth=int(task.has_truth),
            lost_cost=float(lost_cost(task) or 0.0),
        )


def plan_of(
    experiment: Experiment, competitors: Mapping[str, Any], first: int = 0, end: int | None = None
) -> Plan:
    """Check the arguments of an evaluation; return its episodes, and each competitor's model and kind.

    Args:
        experiment: the experiment.
        competitors: competitors by name.
        first: number of the first planned episode; for flights and recordings all episodes are planned.
        end: number after the last planned episode; None with ``first=0``: all.
    """
    cls = experiment.task
    experiment = replace(
        experiment,
        scenario=read_files(cls, experiment.scenario),
        drawn_episodes=check_integer("drawn_episodes", experiment.drawn_episodes, 0),
    )
    chosen = find_scenario(cls, experiment.scenario, experiment.keywords)
    episodes, seed, split, control = (
        experiment.episodes, experiment.seed, experiment.split, experiment.control
    )  # fmt: skip
    if control is not None and not (isinstance(control, str) and control in cls.controls):
        raise nearest("control", control, cls.controls)
    if not competitors:
        raise ValueError("name at least one policy")
    seeds = episode_seeds(split, seed, episodes if end is None else end - first, first)
    kinds: dict[str, Kind] = {name: kind_of(maker) for name, maker in competitors.items()}
    models: dict[str, Model] = {}
    # Every task is made before any episode runs, so that a wrong keyword costs nothing.
    for name, maker in competitors.items():
        models[name] = experiment.make_model(maker, control_of(maker, control, cls, name))
    for name, model in models.items():
        check_observation(model, competitors[name], name)
        if kinds[name] == "smoother":
            check_open_loop(model, f"smoother {name!r}")
    model = next(iter(models.values()))
    if chosen.recording is not None:
        for name, kind in kinds.items():
            if kind in INFORMED_KINDS:
                raise ValueError(
                    f"{kind} {name!r} needs truth that recording {chosen.name!r} does not contain, beyond the "
                    "components: leave it out"
                )
        episodes = len(model.task.flights)  # nothing is random, so each flight is run once
    flown, lengths = None, None
    if model.task.flights:
        seeds, flown, lengths = _flights_in_turn(model, split, seed, episodes)
    if chosen.recording is not None and flown is not None and lengths is not None:
        order = numpy.argsort(flown)
        seeds, flown, lengths = [seeds[i] for i in order], flown[order], lengths[order]
    competitors = dict(competitors)
    for name, one in competitors.items():
        if hasattr(one, "of_tracks"):
            check_open_loop(models[name], repr(name))
            named = [str(first + i) for i in range(len(seeds))]
            if chosen.recording is not None and flown is not None:
                named = [chosen.flights[i] for i in flown]
            competitors[name] = one.of_tracks(
                models[name].on_numpy().task, dict(zip(seeds, named, strict=True))
            )
    return Plan(experiment, competitors, kinds, models, chosen, seeds, first, flown, lengths)


def check_sendable(task: type[Task], competitors: Mapping[str, Any]) -> None:
    """Raise ValueError for a task or competitor that cannot be imported or unpickled in another process."""
    if importable_name(task).startswith("__main__:"):
        raise ValueError(
            f"{task.id} is registered by the running program, which other processes do "
            "not run: register it in a module of its own, or leave out jobs and cluster"
        )
    for name, maker in competitors.items():
        try:
            cloudpickle.dumps(maker)
        except Exception as error:  # pickling can raise any error
            raise ValueError(
                f"{name!r} cannot be sent to another process ({error}): give its class, or leave out jobs and cluster"
            ) from error


def _flights_in_turn(
    model: Model, split: str, seed: int, episodes: int
) -> tuple[list[int], numpy.ndarray, numpy.ndarray]:
    """Return seeds, flight numbers and lengths of episodes that fly each flight equally often."""
    count = len(model.task.flights)
    share = -(-episodes // count)
    found: list[int] = []
    flown: list[int] = []
    lengths: list[int] = []
    missing = numpy.full(count, share)
    first = 0
    while missing.any():
        candidates = episode_seeds(split, seed, share * count, first)
        uniforms = uniforms_of_seeds(candidates, model.task.noise)
        drawn = zip(candidates, model.task.flight_of(uniforms), model.task.lengths(uniforms), strict=True)
        for candidate, flight, length in drawn:
            if missing[flight]:
                missing[flight] -= 1
                found.append(candidate)
                flown.append(int(flight))
                lengths.append(int(length))
        first += share * count
    return found, numpy.array(flown), numpy.array(lengths)
