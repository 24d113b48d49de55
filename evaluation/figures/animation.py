"""Animations of an episode with the estimates of a competitor, as GIF files."""

from pathlib import Path
from typing import Any

import numpy
from PIL import Image

from ...envs.contract.model import Episode, Model
from ...envs.contract.parameters import check_integer
from ...envs.contract.task import Task
from ...envs.engine.backend import make_model
from ...envs.engine.episode_noise import uniforms_of_seeds
from ...envs.engine.scenario_choice import find_scenario
from ...envs.interface.environment import TaskEnv
from ..competitors.kinds import kind_of, make_competitor
from ..competitors.stepping import SteppingPolicy
from ..running.evaluate import control_of
from ..running.rollout import run_competitor
from ..storage.files import whole_file

SHADES = 7
"""Number of shades between a colour of the figure and white, for smooth edges."""


def episode_frames(
    task: type[Task],
    name: str,
    competitor: Any,
    scenario: Any = None,
    seed: int = 0,
    every: int = 2,
    **keywords: Any,
) -> list[Image.Image]:
    """Run one episode of a competitor; return pictures of its estimates, one for each frame of an animation.

    Args:
        task: task class of the environment.
        name: name of the competitor.
        competitor: policy, estimator, smoother or reference, or its maker.
        scenario: name of a scenario, or a trajectory.
        seed: seed of the episode, as in ``reset``.
        every: number of actions from one frame to the next; the last action always has a frame.
        **keywords: parameters of the task.

    Raises:
        ValueError: for unknown names, and for bounds, which have no estimates.
    """
    every, kind = check_integer("every", every, 1), kind_of(competitor)
    if kind == "bound":
        raise ValueError(f"{name!r} is a bound: it has no estimates to draw")
    keywords = {**getattr(competitor, "task_keywords", {}), **keywords}
    if kind == "policy":
        control = control_of(competitor, None, task, name)
        world = TaskEnv(task.id, control, scenario, render_mode="rgb_array", **keywords)
        return _policy_frames(world, name, competitor, seed, every)
    model, chosen = (
        make_model(task, task.controls[0], scenario, **keywords),
        find_scenario(task, scenario, keywords),
    )
    return _estimate_frames(model, chosen.name, name, competitor, seed, every)


def _policy_frames(world: TaskEnv, name: str, policy: Any, seed: int, every: int) -> list[Image.Image]:
    assert world.picture is not None
    world.picture.caption = f"policy {name}"
    actor = SteppingPolicy(world.model, make_competitor(policy, world.model))
    observation, _ = world.reset(seed=seed)
    frames, memory, finished = [Image.fromarray(_frame(world))], actor.begin([seed]), False
    taken = 0
    while not finished:
        action, memory = actor.predict(observation, memory)
        observation, _, _, finished, _ = world.step(action)
        taken += 1
        if finished or taken % every == 0:
            frames.append(Image.fromarray(_frame(world)))
    world.close()
    return frames


def _estimate_frames(
    model: Model, scenario: str, name: str, estimator: Any, seed: int, every: int
) -> list[Image.Image]:
    """Return the frames of an episode of an estimator, smoother or reference."""
    # They import matplotlib.
    from ...envs.drawing.estimate_picture import EstimatePicture
    from ...envs.drawing.rendering import EpisodePicture

    kind = kind_of(estimator)
    length = int(model.task.lengths(uniforms_of_seeds([seed], model.task.noise))[0])
    found = run_competitor(model, estimator, kind, [seed], _picture_track)
    track = {key: values[0, :length] for key, values in found.items()}
    drawn = EstimatePicture(model, track)
    picture = EpisodePicture(model, scenario, "rgb_array", 1.0, drawn)
    picture.caption = f"{kind} {name}"
    frames, step = [], every * model.task.decision_interval
    for k in range(length):
        picture.append(drawn.values(track, k))
        if (k + 1) % step == 0 or k == length - 1:
            frames.append(Image.fromarray(picture.frame(None)))
    picture.close()
    return frames


def _picture_track(model: Model, episode: Episode) -> dict[str, Any]:
    return model.picture_track(episode)


def _frame(world: TaskEnv) -> Any:
    frame = world.render()
    assert frame is not None
    return frame


def _palette() -> Image.Image:
    """Return an image with the palette of all frames, so that colours do not flicker."""
    from matplotlib.colors import to_rgb

    # Imported here, as in the environment, since it is optional.
    from ...envs.drawing import rendering

    white = numpy.ones(3)
    share = numpy.arange(SHADES)[:, None] / SHADES
    shades = [(1.0 - share) * to_rgb(colour) + share * white for colour in rendering.COLOURS]
    image = Image.new("P", (1, 1))
    image.putpalette(
        numpy.rint(255.0 * numpy.concatenate([white[None], *shades])).astype(int).ravel().tolist()
    )
    return image


def write_animation(frames: list[Image.Image], path: Path, frames_per_second: float = 6.0) -> None:
    """Write frames as an endless GIF, whose last frame lasts two seconds."""
    palette = _palette()
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [round(1000.0 / frames_per_second)] * (len(drawn) - 1) + [2000]
    with whole_file(path) as partial:
        drawn[0].save(
            partial,
            format="GIF",
            save_all=True,
            append_images=drawn[1:],
            duration=durations,
            loop=0,
            optimize=True,
        )
