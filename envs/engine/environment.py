"""The two Gymnasium faces of a task: ``TaskEnv`` with one episode, ``TaskVectorEnv`` with many."""

import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ...filters.array_namespace import host_array, is_tensor, tensor_on
from ..contract.model import Model
from ..contract.observation import Array, Field
from ..contract.parameters import Limits, check, freeze
from ..contract.task import Task
from .backend import make_model
from .catalogue import check_names, nearest, task_class
from .fleet import Course, Fleet, check_alike
from .lanes import Lanes, mean_of
from .privileged import context_shapes, in_sigmas
from .reward import REWARDS
from .scenario_choice import ScenarioChoice, find_mixture, find_scenario
from .specification import with_episode_length
from .step_report import step_report

if TYPE_CHECKING:
    from ..drawing.rendering import EpisodePicture, EpisodePictures
    from .late_picture import LatePicture

FRAMES_PER_SECOND = 10
DTYPES = ("float64", "float32")
"""Types of observations and rewards; inside everything is float64."""
OBSERVATIONS = ("measured", "asymmetric")
"""What an observation holds: what can be known; or beside it, for critics in training, what cannot."""


def _check_seed(seed: Any) -> int | None:
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | numpy.integer) or seed < 0:
        raise ValueError(f"a seed is None or an integer of at least 0, got {seed!r}")
    return int(seed)


def _check_options(options: Any, known: Iterable[str]) -> Mapping[str, Any]:
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"options of a reset are a dictionary or None, got {options!r}")
    for name in options:
        if name not in known:
            raise nearest("option of a reset", name, known)
    return options


FEW = 16
"""Numbers that are looked at one by one sooner than by NumPy."""


def _all_finite(values: Array) -> bool:
    if isinstance(values, numpy.ndarray) and values.size <= FEW:
        return all(map(math.isfinite, values.ravel().tolist()))
    # The sum is finite unless an entry is not, and costs a third of asking for every entry. It may overflow.
    with numpy.errstate(over="ignore", invalid="ignore"):
        return math.isfinite(values.sum()) or all(map(math.isfinite, values.reshape(-1).tolist()))


def check_action(space: gymnasium.Space, action: Any, count: int | None) -> Array:
    """Return the action as an array, or as the tensor that it is, or say what arrived and what was expected."""
    if is_tensor(action):
        array, values = action, action.detach()
        floating, real = (
            values.is_floating_point(),
            str(values.dtype) != "torch.bool" and not values.is_complex(),
        )
    else:
        array = values = numpy.asarray(action)
        floating, real = values.dtype.kind == "f", values.dtype.kind in "fiu"
    if isinstance(space, gymnasium.spaces.Discrete):
        shape: tuple[int, ...] = () if count is None else (count,)
        n = int(space.n)
        if array.shape != shape or floating or not real or (values < 0).any() or (values >= n).any():
            raise _action_error(f"integer actions from 0 to {n - 1} of shape {shape}", values)
        return array
    assert space.shape is not None
    shape = space.shape if count is None else (count, *space.shape)
    if array.shape != shape or not real or not _all_finite(values):
        raise _action_error(f"finite actions of shape {shape}", values)
    return array


def _action_error(expected: str, action: Array) -> ValueError:
    shown = numpy.array2string(host_array(action), threshold=8)
    return ValueError(f"expected {expected}, got {action.dtype} of shape {tuple(action.shape)}: {shown}")


def _no_truth(course: Course) -> str:
    known = any(model.task.has_truth for model in course.models)
    lacks = "lacks some of the truth, so the reward" if known else "has no truth, so the cost"
    return f"recording {course.names[0]!r} {lacks} of an estimate is not known"


@dataclass(frozen=True)
class EnvOptions:
    """What a user of either environment may choose beside the task and its parameters; see :class:`TaskEnv`.

    Raises:
        ValueError: for a value that is none of the choices.
    """

    reward: str | None = None
    """Kind of reward; None: the environment's own."""
    detailed_info: bool = False
    dtype: str = "float64"
    context: bool = False
    observation: str = "measured"

    def __post_init__(self) -> None:
        if not isinstance(self.dtype, str) or self.dtype not in DTYPES:  # a NumPy dtype equals its name
            raise nearest("dtype", self.dtype, DTYPES)
        if self.observation not in OBSERVATIONS:
            raise nearest("observation", self.observation, OBSERVATIONS)
        check("detailed_info", self.detailed_info, bool, Limits())
        check("context", self.context, bool, Limits())

    @property
    def privileged(self) -> bool:
        """Whether observations hold what no policy can know."""
        return self.observation == "asymmetric"


class _OneThread:
    """Lets one thread at a time into a block and refuses others; of a list, since a lock can be neither copied nor
    pickled with an environment.
    """

    def __init__(self) -> None:
        self._free = [True]

    def __enter__(self) -> None:
        """Enter, or raise gymnasium.error.Error if another thread is inside."""
        try:
            self._free.pop()
        except IndexError:
            raise gymnasium.error.Error(
                "another thread steps or resets these environments at the same time: give each thread its own"
            ) from None

    def __exit__(self, *_: object) -> None:
        self._free.append(True)


class _EnvBase:
    """What both environments share: a task, its spaces, and the reward."""

    model: Model
    """Where scenarios are mixed: of the single environment the one that is flown, of a vector the first."""
    fleet: Fleet
    options: EnvOptions
    reward_kind: str
    last_decision: int
    """Actions after which an episode is truncated, where scenarios differ in length the longest one."""
    reset_options: ClassVar[tuple[str, ...]] = ("scenario", "parameters")
    """Names that ``options`` of a reset may have."""
    _spec: EnvSpec | None = None

    @property
    def task(self) -> Task:
        """What the model is of."""
        return self.model.task

    def _set_options(self, task: str, options: EnvOptions, names: Iterable[str]) -> None:
        """Keep the options; refuse an unknown environment or parameter before anything is made."""
        self._class = task_class(task)
        check_names(self._class, names, inspect.signature(type(self)).parameters)
        self.options = options
        self.reward_kind = self._class.reward if options.reward is None else options.reward
        if self.reward_kind not in REWARDS:
            raise nearest("reward", self.reward_kind, REWARDS)
        self._rewards_only = not (options.detailed_info or options.privileged)
        if self.privileged:
            self.metadata: dict[str, Any] = {**self.metadata, "privileged": True}

    @property
    def privileged(self) -> bool:
        """Whether observations hold what no policy can know."""
        return self.options.privileged

    def _open(
        self,
        make: Callable[..., Model],
        scenario: Any,
        keywords: Mapping[str, Any],
        count: int,
        longest: int | None,
    ) -> None:
        """Make the lanes.

        Args:
            make: makes a model of a scenario and parameters.
            scenario: as the user has named it.
            keywords: parameters of the task.
            count: number of lanes.
            longest: decisions after which an episode ends at the latest.
        """
        self._make, self._keywords = make, dict(keywords)
        course = self._course(scenario, {})
        if not all(model.task.has_whole_truth for model in course.models):
            self._disable_reward(course)
        self.model, self._first_course = course.models[0], course
        self.fleet = Fleet(count, course, self.reward_kind, longest)
        self.last_decision = self.fleet.decisions_per_episode
        self._scaled_errors: Array = None
        """Errors after the last action, in sigmas, ``(count, components)``; only where observations are privileged."""
        if self.privileged:
            self._scaled_errors = self.task.constant(numpy.zeros((count, len(self.task.components))))

    def _disable_reward(self, course: Course) -> None:
        """Set every reward to zero, where the truth is not known.

        Raises:
            ValueError: if a reward was asked for, or what is privileged.
        """
        wanted = f"reward={self.reward_kind!r}" if self.options.reward is not None else ""
        wanted = "observation='asymmetric'" if self.privileged else wanted
        if wanted:
            raise ValueError(f"{_no_truth(course)}: leave out {wanted}; rewards are zero")
        self.reward_kind = "none"

    # --- scenarios

    def _course(self, scenario: Any, parameters: Mapping[str, Any]) -> Course:
        """Make the tasks of a scenario or a mixture, with parameters beside those of the environment.

        Raises:
            ValueError: for an unknown name, a value out of its limits, or what would change the spaces.
        """
        keywords = {**self._keywords, **parameters}
        mixture = find_mixture(self._class, scenario)
        choices = [scenario] if mixture is None else list(mixture)
        found = [find_scenario(self._class, choice, keywords) for choice in choices]
        models = tuple(self._make(one, **keywords) for one in found)
        names = tuple(one.name for one in found)
        course = Course(
            scenario,
            dict(parameters),
            models,
            names,
            (1.0,) if mixture is None else tuple(mixture.values()),
        )
        if (
            hasattr(self, "model")
            and self.reward_kind != "none"
            and not all(t.task.has_whole_truth for t in models)
        ):
            raise ValueError(
                f"{_no_truth(course)}, and this environment gives rewards: make another one of it"
            )
        first = getattr(self, "model", models[0])
        for model, name in zip(models, names, strict=True):
            check_alike(first, model, name)
            if self.privileged and context_shapes(model.task) != context_shapes(first.task):
                raise ValueError(
                    f"scenario {name!r} has a context of another shape than this environment shows its critics: leave "
                    "it out, or make the environment without observation='asymmetric'"
                )
        return course

    def _apply_reset_options(self, wanted: Mapping[str, Any], chosen: Sequence[int]) -> None:
        """Apply the scenario and the parameters of a reset to the coming episodes of these lanes."""
        if not {"scenario", "parameters"} & wanted.keys():
            return
        parameters = wanted.get("parameters")
        if parameters is not None and not (
            isinstance(parameters, Mapping) and all(isinstance(name, str) for name in parameters)
        ):
            raise ValueError(f"options['parameters'] maps names of parameters to values, got {parameters!r}")
        known = [self._first_course, *self.fleet.courses()]
        courses = []
        for lane in chosen:
            now = self.fleet.course_of(lane)
            asked = now.scenario, now.parameters
            if "scenario" in wanted:
                scenario = wanted["scenario"]
                asked = (self._first_course.scenario if scenario is None else scenario), asked[1]
            if "parameters" in wanted:
                asked = asked[0], dict(parameters or {})
            found = next((course for course in known if course.is_of(*asked)), None)
            if found is None:
                found = self._course(*asked)
                known.append(found)
            courses.append(found)
        for lane, course in zip(chosen, courses, strict=True):
            self.fleet.send(lane, course)
        self.last_decision = self.fleet.decisions_per_episode

    # --- what is shown

    def _observation_space(self) -> gymnasium.Space:
        dtype = numpy.dtype(self.options.dtype).type
        low, high = (limits.astype(dtype) for limits in self.model.observation_limits)
        measured = gymnasium.spaces.Box(low, high, dtype=dtype)
        if not self.privileged:
            return measured
        context = sum(math.prod(shape) for shape in context_shapes(self.task).values())
        return gymnasium.spaces.Dict(
            {
                "observation": measured,
                "privileged": gymnasium.spaces.Box(
                    -numpy.inf, numpy.inf, (context + len(self.task.components),), dtype
                ),
            }
        )

    def _to_dtype(self, values: Array) -> Array:
        """Numbers in the type that was asked for."""
        if self.options.dtype == "float64":
            return values
        return self.task.xp.astype(values, self.task.xp.float32)

    def _observations(self) -> Any:
        """Observations of all lanes, batch first."""
        shown = self._to_dtype(self.fleet.observe())
        if not self.privileged:
            return shown
        xp, count = self.task.xp, self.fleet.count
        flat = [xp.reshape(values, (count, -1)) for values in self._context()[0].values()]
        return {
            "observation": shown,
            "privileged": self._to_dtype(xp.concat([*flat, self._scaled_errors], axis=1)),
        }

    def _context(self) -> tuple[dict[str, Array], dict[str, numpy.ndarray]]:
        """Context of all lanes, batch first, and which of them has each part of it."""
        found = []
        for (part,) in self.fleet.parts():
            context, xp = part.model.context(part.state), part.task.xp
            found.append({name: xp.moveaxis(v[..., : part.count], -1, 0) for name, v in context.items()})
        return self._gather_reports(found)

    def _gather_reports(
        self, found: Sequence[Mapping[str, Array]]
    ) -> tuple[dict[str, Array], dict[str, numpy.ndarray]]:
        """Put together what the lanes of several tasks report, and say who reports each part of it.

        Where one reports more numbers than another, and where one reports nothing, NaN stands for what is missing.
        """
        xp, values, present = self.task.xp, {}, {}
        counts = [part.count for (part,) in self.fleet.parts()]
        for name in dict.fromkeys(name for one in found for name in one):
            shapes = [tuple(one[name].shape[1:]) for one in found if name in one]
            largest = tuple(map(max, zip(*shapes, strict=True)))
            padded = []
            for one, count in zip(found, counts, strict=True):
                full = self.task.constant(numpy.full((count, *largest), numpy.nan))
                if name in one:
                    if tuple(one[name].shape[1:]) == largest:
                        full = one[name]
                    else:
                        full[tuple(slice(size) for size in one[name].shape)] = xp.astype(
                            one[name], xp.float64
                        )
                padded.append(full)
            values[name] = self.fleet.gather(padded)
            has = [numpy.full(count, name in one) for one, count in zip(found, counts, strict=True)]
            present[name] = self.fleet.gather(has)
        return values, present

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made this from; its ``max_episode_steps`` is the length of an episode in decisions."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else with_episode_length(spec, self.last_decision)

    @property
    def backend(self) -> str:
        """What computes the steps: "compiled", "numpy" or "torch"."""
        return self.model.backend

    # --- a step

    def _step_lanes(
        self, action: Array, info: dict[str, Array], watch: Callable[[Any], None] | None = None
    ) -> Array:
        """Step the lanes and return the mean reward over the measurements of this decision, ``(count,)``.

        ``watch`` is called with the state after the action, once for each measurement.
        """
        if self._rewards_only and watch is None:
            return self.fleet.pay(action, self.reward_kind)
        infos: list[dict[str, Array]] = []
        answers = []
        for part, own in self.fleet.parts(action):
            infos.append({})
            answers.append(self._step_part(part, own, infos[-1], watch))
        if self.privileged:
            self._scaled_errors = self.fleet.gather([scaled for _, scaled in answers])
        info.update(self._gather_reports(infos)[0])
        return self.fleet.gather([reward for reward, _ in answers])

    def _step_part(
        self, lanes: Lanes, action: Array, info: dict[str, Array], watch: Callable[[Any], None] | None
    ) -> tuple[Array, Array]:
        """Step lanes of one task; returns rewards, and errors in sigmas where observations are privileged."""
        task, count = lanes.task, lanes.count
        asked = step_report(self.reward_kind, self.privileged, self.options.detailed_info, watch is not None)
        answers = lanes.decide(action, asked)
        if watch is not None:
            for own, _ in answers:
                watch(own.episode)
        last = answers[-1][0]
        for name, values in (last.details or {}).items():
            info[name] = task.xp.moveaxis(values[..., :count], -1, 0)
        rewards = [own.reward if other is None else own.reward - other.reward for own, other in answers]
        scaled = in_sigmas(last.error, last.covariance, count, task.xp) if self.privileged else None
        return mean_of(rewards)[:count], scaled

    def _forget_errors(self, lanes: Sequence[int]) -> None:
        """Episodes that begin have no estimate yet that could be wrong."""
        if self.privileged:
            keep = numpy.ones((self.fleet.count, 1))
            keep[list(lanes)] = 0.0
            self._scaled_errors = self.task.xp.where(self.task.constant(keep) > 0.0, self._scaled_errors, 0.0)

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every component of the observation."""
        return self.model.fields


class TaskEnv(_EnvBase, gymnasium.Env[Any, Any]):
    """One episode of a task at a time.

    Args:
        task: environment id.
        control: what the action steers; default: the first of the environment's controls.
        scenario: name of a scenario, a :class:`~filtergym.envs.data.trajectory.Trajectory` or a dictionary of its
            fields, or the path of a file with one; a :class:`~filtergym.envs.data.recording.Recording`, or its file; or
            a mixture, ``{"random": 0.8, "paper": 0.2}``, of which every episode flies one scenario, drawn by these
            weights from ``np_random``.
        reward: "cost", "log-likelihood", "cost-and-likelihood" or "relative", see :mod:`.reward`; default: the
            environment's own, and zero on a recording without truth.
        render_mode: None, "rgb_array" or "human".
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Task.track`), error,
            cost and what else an evaluation records.
        backend: "auto" (default), "compiled" or "numpy"; see :func:`~.backend.make_model`.
        dtype: of observations and rewards: "float64" (default), or "float32", to which they are rounded when they are
            given out.
        context: whether ``info["context"]`` tells what was drawn for the episode and what of it holds now
            (:meth:`.Task.context`), at resets and steps.
        observation: "measured" (default), or "asymmetric", for critics in training: a dictionary of the "observation"
            and of what is "privileged", the context and the error after the last action in units of its reported
            standard deviation (zero at a reset). No policy may be shown that where it is judged.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name or a value out of its limits; an unknown keyword is a TypeError too.
        ImportError: for the compiled backend without llvmlite.
    """

    metadata = {  # noqa: RUF012 (as in gymnasium.Env)
        "render_modes": ["human", "rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        task: str,
        control: str | None = None,
        scenario: ScenarioChoice = None,
        reward: str | None = None,
        render_mode: str | None = None,
        detailed_info: bool = False,
        backend: str = "auto",
        dtype: str = "float64",
        context: bool = False,
        observation: str = "measured",
        **keywords: Any,
    ) -> None:
        self._set_options(task, EnvOptions(reward, detailed_info, dtype, context, observation), keywords)
        if backend == "torch":
            raise ValueError("backend 'torch' is for many episodes at once: use gymnasium.make_vec")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        self._open(
            functools.partial(make_model, self._class, control, backend=backend), scenario, keywords, 1, None
        )
        self.render_mode = render_mode
        self._late: LatePicture | None = None
        if render_mode is not None:
            self._picture_of(self._first_course.names[0])
        self.observation_space = self._observation_space()
        self.action_space = self.model.action_space

    def _picture_of(self, scenario: str) -> None:
        """Draw episodes of the present task, of a scenario of this name."""
        # Only here: matplotlib takes longer to import than an episode takes to run.
        from ..drawing.rendering import EpisodePicture
        from .late_picture import LatePicture

        assert self.render_mode is not None
        self._late = LatePicture(EpisodePicture(self.model, scenario, self.render_mode, FRAMES_PER_SECOND))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode and show its first measurement.

        ``options["scenario"]``: what ``scenario`` of the environment takes; None is the environment's own again.
        ``options["parameters"]``: parameters that go before those of the environment; ``{}`` for none. Each holds until
        a reset names another.

        Raises:
            ValueError: for a seed that is none, other options, an unknown name or a value out of its limits in them,
                and for a scenario or parameters that would change the spaces.
        """
        wanted, seed = _check_options(options, self.reset_options), _check_seed(seed)
        self._apply_reset_options(wanted, [0])
        super().reset(seed=seed)
        self.fleet.seed(0, self.np_random)
        self.fleet.restart()
        self._forget_errors([0])
        self.model = self.fleet.model_of(0)
        if self._late is not None and self._late.model is not self.model:
            self._late.close()
            self._picture_of(self.fleet.scenario_of(0))
        if self._late is not None:
            self._late.begin(self.fleet.identity_of(0))
            self._show()
        return self._single_observation(), self._with_context({})

    def _single_observation(self) -> Any:
        """Observation of the one episode."""
        if not self.privileged:
            return self._to_dtype(self.fleet.observe()[0])
        return {name: values[0] for name, values in self._observations().items()}

    def _with_context(self, info: dict[str, Any]) -> dict[str, Any]:
        if self.options.context:
            info["context"] = {name: values[0] for name, values in self._context()[0].items()}
        return info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply the action to the measurement just shown, then show the next one."""
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        if self.fleet.done[0]:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset before the next step")
        array = check_action(self.action_space, action, None)
        info: dict[str, Any] = {}
        reward = self._step_lanes(array[None], info)
        if self._late is not None:
            self._late.keep(array)
            self._show()
        if info:
            info = {name: values[0] for name, values in info.items()}
        if self.options.context:
            self._with_context(info)
        reward = float(self._to_dtype(reward)[0])
        return self._single_observation(), reward, False, bool(self.fleet.done[0]), info

    def _show(self) -> None:
        """Draw into the window of render mode "human"."""
        if self._late is not None and self.render_mode == "human":
            self._late.show()

    @property
    def picture(self) -> "EpisodePicture | None":
        """What keeps and draws the episode, up to date; None without a render mode."""
        return None if self._late is None else self._late.picture

    def render(self) -> numpy.ndarray | None:
        """Draw the episode so far.

        Returns:
            ``(height, width, 3)`` bytes in render mode "rgb_array"; None in "human", whose window is drawn by
            every reset and step anyway.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._late is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gym.make(..., render_mode="rgb_array")'
            )
            return None
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        if self.render_mode == "human":
            self._show()
            return None
        return self._late.frame()

    def close(self) -> None:
        """Close the window."""
        if self._late is not None:
            self._late.close()


class TaskVectorEnv(_EnvBase, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many episodes of a task side by side, natively vectorised.

    Args:
        task: environment id.
        num_envs: number of sub-environments; sub-environment i equals the single environment with the same
            seed, whatever the number.
        control: what the action steers.
        scenario: name of a scenario, a trajectory or a dictionary of its fields, or the path of a file with one; or a
            mixture, ``{"random": 0.8, "paper": 0.2}``.
        reward: "cost", "log-likelihood", "cost-and-likelihood", "relative" or "log-relative"; default: the
            environment's own.
        render_mode: None, or "rgb_array": :meth:`render` draws the first few sub-environments.
        backend: "auto" (default), "compiled" or "numpy", see :func:`~.backend.make_model`; or "torch": observations,
            rewards, masks and ``info`` are tensors, actions may be. Episodes are the same everywhere, their
            random numbers made on the host; float64 results differ by rounding. Torch's gradients flow from rewards and
            observations back to actions that require them, over all steps since the last reset; pass detached
            actions where none are wanted.
        device: where the torch backend computes, such as "cpu" (default) or "cuda".
        threads: how many share the sub-environments, of the compiled backend; the numbers stay the same.
        autoreset_mode: a :class:`gymnasium.vector.AutoresetMode` or its value.
        max_episode_steps: truncate earlier than the task's horizon (``make_vec`` passes it on); None or -1: do not.
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Task.track`), error,
            cost and what else an evaluation records.
        dtype: of observations and rewards: "float64" (default), or "float32", to which they are rounded when they are
            given out.
        context: whether ``info["context"]`` tells what was drawn for the episode and what of it holds now
            (:meth:`.Task.context`), at resets and steps.
        observation: "measured" (default), or "asymmetric", for critics in training: a dictionary of the "observation"
            and of what is "privileged", the context and the error after the last action in units of its reported
            standard deviation (zero at a reset). No policy may be shown that where it is judged.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name, a value out of its limits, or a device that is not there; an unknown keyword is
            a TypeError too.
        ImportError: for a backend whose library is not installed.
    """

    metadata = {  # noqa: RUF012 (as in gymnasium.vector.VectorEnv)
        "render_modes": ["rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }
    reset_options = ("reset_mask", "shortened_by", "scenario", "parameters")
    pictures: "EpisodePictures | None" = None
    """What keeps and draws the first few episodes; None without a render mode."""

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        control: str | None = None,
        scenario: ScenarioChoice = None,
        reward: str | None = None,
        render_mode: str | None = None,
        backend: str = "auto",
        device: Any = None,
        threads: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        detailed_info: bool = False,
        dtype: str = "float64",
        context: bool = False,
        observation: str = "measured",
        **keywords: Any,
    ) -> None:
        self._set_options(task, EnvOptions(reward, detailed_info, dtype, context, observation), keywords)
        num_envs, max_episode_steps = freeze(num_envs), freeze(max_episode_steps)
        check("num_envs", num_envs, int, Limits(at_least=1))
        if max_episode_steps not in (None, -1):
            check("max_episode_steps", max_episode_steps, int, Limits(at_least=1))
        modes = {mode.value: mode for mode in AutoresetMode}
        if not isinstance(autoreset_mode, AutoresetMode):
            if not isinstance(autoreset_mode, str) or autoreset_mode not in modes:
                raise nearest("autoreset_mode", autoreset_mode, modes)
            autoreset_mode = modes[autoreset_mode]
        if render_mode == "human":
            raise ValueError(
                "render_mode 'human' is a window for one episode: use gymnasium.make, or render_mode='rgb_array'"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        make = functools.partial(
            make_model, self._class, control, backend=backend, device=device, threads=threads
        )
        self._open(make, scenario, keywords, num_envs, None if max_episode_steps == -1 else max_episode_steps)
        self.device = self.task.device
        self.autoreset_mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.num_envs = num_envs
        self.render_mode = render_mode
        if render_mode is not None:
            from ..drawing.rendering import EpisodePictures

            if self.fleet.mixes_scenarios:
                raise ValueError(
                    "a vector of environments that mix scenarios cannot be drawn: use gymnasium.make, or one scenario"
                )
            name = self._first_course.names[0]
            self.pictures = EpisodePictures(self.model, name, num_envs, FRAMES_PER_SECOND)
        self.single_observation_space = self._observation_space()
        self.single_action_space = self.model.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._in_use = _OneThread()
        self._finished = numpy.zeros(num_envs, dtype=bool)
        self._never = numpy.zeros(num_envs, dtype=bool)

    def _check_seeds(self, seed: Any) -> list[int | None]:
        if not isinstance(seed, Sequence | numpy.ndarray) or isinstance(seed, str):
            first = _check_seed(seed)
            return [None if first is None else first + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, one for each sub-environment, got {len(seed)}")
        return [_check_seed(one) for one in seed]

    def _seed(self, seeds: Sequence[int | None], lanes: Sequence[int]) -> None:
        unseeded = not self.fleet.generators
        for lane in range(self.num_envs) if unseeded else lanes:
            if unseeded or seeds[lane] is not None:
                self.fleet.seed(lane, gymnasium.utils.seeding.np_random(seeds[lane])[0])

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes everywhere, or where ``options["reset_mask"]`` is true.

        ``options["shortened_by"]``: integers ``(num_envs,)``, by how many decisions each of these episodes ends
        early (later ones are whole again), so that episodes of one horizon need not all end together.

        ``options["scenario"]`` and ``options["parameters"]``: as of the single environment, of the sub-environments
        that are reset; each holds for their coming episodes, also after an autoreset, until a reset names another.

        Raises:
            ValueError: for other options, an unknown name or a value out of its limits in them, a scenario or
                parameters that would change the spaces, and for seeds that are none.
            gymnasium.error.ResetNeeded: for a mask before the first reset.
        """
        with self._in_use:
            return self._reset(seed, options)

    def _reset(
        self, seed: int | Sequence[int | None] | None, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        wanted = _check_options(options, self.reset_options)
        seeds = self._check_seeds(seed)
        mask = wanted.get("reset_mask")
        if self.pictures is not None and {"scenario", "parameters"} & wanted.keys():
            raise ValueError(
                "a vector of environments that is drawn flies one scenario: leave out render_mode, or scenario and "
                "parameters in the options of a reset"
            )
        if mask is None:
            chosen: Sequence[int] = range(self.num_envs)
        else:
            mask = host_array(mask) if is_tensor(mask) else mask
            if (
                not isinstance(mask, numpy.ndarray)
                or mask.dtype != bool
                or mask.shape != (self.num_envs,)
                or not mask.any()
            ):
                raise ValueError(
                    f"options['reset_mask'] must be a boolean array of shape ({self.num_envs},) with "
                    f"at least one True, got {mask!r}"
                )
            if not self.fleet.has_episodes and not mask.all():
                raise gymnasium.error.ResetNeeded("reset every sub-environment once before resetting some")
            chosen = numpy.flatnonzero(mask).tolist()
        shortened = wanted.get("shortened_by")
        if shortened is not None:
            shortened = self._check_shortening(shortened)
        self._apply_reset_options(wanted, chosen)
        self._seed(seeds, chosen)
        self._restart(chosen)
        if shortened is not None:
            self.fleet.shorten(chosen, shortened[list(chosen)])
        self._finished = self._finished.copy()
        self._finished[list(chosen)] = False
        begun = numpy.isin(numpy.arange(self.num_envs), chosen)
        return self._observations(), self._with_context({}, begun)

    def _with_context(self, info: dict[str, Any], lanes: numpy.ndarray) -> dict[str, Any]:
        """Add the context of some lanes to ``info``, in Gymnasium's form, if it is wanted."""
        if self.options.context and lanes.any():
            values, present = self._context()
            context = {}
            for name, array in values.items():
                context[name], context[f"_{name}"] = array, self._mask(present[name] & lanes)
            info["context"], info["_context"] = context, self._mask(lanes)
        return info

    def _check_shortening(self, values: Any) -> numpy.ndarray:
        try:
            shortened = numpy.asarray(values)
        except (ValueError, TypeError):  # rows of different lengths, a tensor on a device
            shortened = numpy.empty(0)
        if (
            shortened.shape != (self.num_envs,)
            or shortened.dtype.kind not in "iu"
            or (shortened < 0).any()
            or (shortened >= self.last_decision).any()
        ):
            raise ValueError(
                f"options['shortened_by'] must hold {self.num_envs} integers from 0 to "
                f"{self.last_decision - 1}, got {values!r}"
            )
        return shortened

    def _restart(self, lanes: Sequence[int]) -> None:
        self.fleet.restart(lanes)
        self._forget_errors(lanes)
        if self.pictures is not None:
            self.pictures.begin(self.fleet.only.state, lanes)

    def step(self, actions: Any) -> tuple[Any, Array, numpy.ndarray, numpy.ndarray, dict[str, Any]]:
        """Apply the actions to the measurements just shown, then show the next ones.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, and where an episode has ended and none begins anew.
            gymnasium.error.Error: where another thread steps or resets the same environments.
        """
        with self._in_use:
            return self._step(actions)

    def _step(self, actions: Any) -> tuple[Any, Array, numpy.ndarray, numpy.ndarray, dict[str, Any]]:
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        waiting = self._finished
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {numpy.flatnonzero(waiting).tolist()} are finished: reset them with "
                "options={'reset_mask': ...}"
            )
        array = self._actions(actions)
        info: dict[str, Any] = {}
        reward = self._step_lanes(array, info, self._watch(array))
        if waiting.any():
            # NEXT_STEP: this step only resets those that finished in the last one; their action is ignored.
            self._restart(numpy.flatnonzero(waiting).tolist())
            reward = self.task.xp.where(self._mask(waiting), 0.0, reward)
        finished = self.fleet.done
        if self.autoreset_mode is AutoresetMode.SAME_STEP and finished.any():
            done = numpy.flatnonzero(finished)
            info = self._with_masks(info, ~finished) | {
                "final_obs": self._final_observations(self._observations(), done),
                "_final_obs": self._mask(finished),
                "final_info": self._with_context(self._with_masks(info, finished), finished),
                "_final_info": self._mask(finished),
            }
            self._restart(done.tolist())
            self._finished = self._never
        else:
            info = self._with_masks(info, ~waiting)
            self._finished = finished
        if self.options.context:
            self._with_context(info, ~self._never)
        shown, reward = self._observations(), self._to_dtype(reward)
        return shown, reward, self._mask(self._never), self._mask(finished), info

    def _watch(self, action: Array) -> Callable[[Any], None] | None:
        """Return what keeps the states of this step for the pictures; None without a render mode."""
        if self.pictures is None:
            return None
        pictures, actions, shown = self.pictures, host_array(action), host_array(self.fleet.observe())
        return lambda state: pictures.keep(state, actions, shown)

    def render(self) -> tuple[numpy.ndarray, ...] | None:
        """Draw the episodes so far of the first few sub-environments (:data:`.rendering.MAX_PICTURES`).

        Returns:
            A frame for each sub-environment, ``(height, width, 3)`` bytes, blank beyond the first few: drawing takes
            far longer than stepping. None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.pictures is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gymnasium.make_vec(..., render_mode="rgb_array")'
            )
            return None
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        return self.pictures.frames(self.fleet.only.state)

    def close_extras(self, **kwargs: Any) -> None:
        """Forget the figures."""
        if self.pictures is not None:
            self.pictures.close()

    def _with_masks(self, info: dict[str, Any], mask: numpy.ndarray) -> dict[str, Any]:
        """Gymnasium's form of what some sub-environments report: a mask beside every key."""
        if not mask.any():
            return {}
        masked = {}
        for name, values in info.items():
            masked[name], masked[f"_{name}"] = values, self._mask(mask)
        return masked

    def _actions(self, actions: Any) -> Array:
        array = check_action(self.single_action_space, actions, self.num_envs)
        if self.backend != "torch":
            return host_array(array)
        return tensor_on(array, self.device)

    def _mask(self, lanes: numpy.ndarray) -> Array:
        """Return booleans of the lanes for the caller to keep: a copy, on the device of the backend."""
        return lanes.copy() if self.backend != "torch" else tensor_on(lanes, self.device)

    def _final_observations(self, last: Any, done: numpy.ndarray) -> Array:
        """Gymnasium's form: an object for each finished sub-environment, None elsewhere.

        With the torch backend one tensor, the last observation of every lane: taking it apart would cost a
        transfer for each lane.
        """
        if self.backend == "torch":
            return last
        final = numpy.full(self.num_envs, None, dtype=object)
        for lane in done:
            final[lane] = {name: v[lane] for name, v in last.items()} if self.privileged else last[lane]
        return final
