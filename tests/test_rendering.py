"""Pictures of episodes: frames, videos, windows, and what must not move."""

import os
import subprocess
import sys

import gymnasium
import numpy
import pytest

from filtergym import evaluate
from filtergym.envs.drawing import estimate_picture, rendering
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.interface.environment import TaskEnv
from filtergym.envs.interface.vector_environment import TaskVectorEnv
from filtergym.envs.maneuvering_target.picture import ellipse_axes
from filtergym.evaluation.figures.animation import episode_frames, write_animation
from filtergym.names import competitor

ID = "filtergym/ManeuveringTarget-v0"


def played(steps, seed=1, **keywords):
    env = TaskEnv(ID, render_mode="rgb_array", **keywords)
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(env.action_space.sample())
    return env


@pytest.mark.parametrize(
    ("control", "general"),
    [("gain", False), ("sigma-points", False), ("evidence", False), ("evidence", True)],
)
def test_frames_are_images_that_change(control, general, monkeypatch):
    """Drawn with the task's own picture, and with the one for tasks that have none."""
    if general:
        monkeypatch.setattr(rendering, "picture_of", rendering.Picture)
    env = gymnasium.make(ID, control=control, render_mode="rgb_array", horizon=1)
    env.reset(seed=3)
    before = env.render()
    env.step(env.action_space.sample())
    after = env.render()
    assert (before.shape, before.dtype) == (after.shape, after.dtype) == ((608, 960, 3), numpy.uint8)
    assert (before != after).any()
    copy = after.copy()
    after[:] = 0
    numpy.testing.assert_array_equal(env.render(), copy, "a frame must not share the canvas's memory")
    env.close()


def test_what_a_bank_of_hypotheses_believes_is_drawn():
    env = TaskEnv(
        "filtergym/UavAutopilot-v0", control="hypotheses", render_mode="rgb_array", horizon=1, backend="numpy"
    )
    env.reset(seed=3)
    before = env.render()
    env.step(env.action_space.sample())
    assert (before != env.render()).any()
    env.close()


def test_reused_figure_shows_what_a_new_one_shows():
    reused, drawn_once = (played(40, control="gain", scenario="paper") for _ in range(2))
    reused.reset(seed=7)
    reused.render()
    reused.action_space.seed(1)
    reused.reset(seed=1)
    for step in range(40):
        if step % 25 == 0:
            reused.render()
        reused.step(reused.action_space.sample())
    numpy.testing.assert_array_equal(reused.render(), drawn_once.render())


def test_axes_stay_where_they_are_and_hold_the_track():
    env = played(0, scenario="paper")
    env.render()
    picture = env.picture.picture
    panels = env.picture._figure.axes

    def places():
        return [tuple(axes.get_position().bounds) for axes in panels], picture.track.viewLim.extents.tolist()

    first = places()
    for scan in range(1, 101):
        env.step(env.action_space.sample())
        if scan in (20, 100):
            env.render()
            assert places() == first
    numpy.testing.assert_allclose(
        numpy.ravel(picture.arrived.get_data()), env.fleet.only.state.measurement.position[:, 0] / 1e3
    )
    left, bottom, right, top = picture.track.viewLim.extents
    x, y = env.picture.history["true_x"], env.picture.history["true_y"]
    assert left < min(x)
    assert max(x) < right
    assert bottom < min(y)
    assert max(y) < top
    # Equal axes: as many kilometres for each pixel along x as along y.
    box = picture.track.get_window_extent()
    assert (right - left) / box.width == pytest.approx((top - bottom) / box.height, rel=1e-9)


def test_history_is_what_info_reports():
    env = TaskEnv(
        ID, "gain", scenario="paper", render_mode="rgb_array", detailed_info=True, decision_interval=2
    )
    env.reset(seed=2)
    for decision in range(1, 4):
        _, _, _, _, info = env.step(numpy.array([0.2 * decision], dtype=numpy.float64))
        history = env.picture.history
        assert {len(values) for values in history.values()} == {2 * decision}
        # The picture's series are plain copies and one hypotenuse: nothing but the last bit may differ.
        numpy.testing.assert_allclose(
            history["position_error"][-1], numpy.linalg.norm(info["error"][:2]), rtol=1e-14
        )
        assert history["error.velocity_y"][-1] == info["error"][3]
        assert history["alpha"][-1] == info["alpha"]
        assert history["action.0"][-2:] == [0.2 * decision] * 2
        # Both innovations are over their own sigma, so their squares add up to the NIS.
        squared = history["innovation_x"][-1] ** 2 + history["innovation_y"][-1] ** 2
        assert squared == pytest.approx(float(info["nis"]), rel=1e-12)
    assert "scan 6 of 100" in env.picture.title
    assert "scenario paper" in env.picture.title
    env.reset(seed=2)
    assert "scan 0 of 100" in env.picture.title
    assert not env.picture.history


def test_manoeuvres_are_marked_where_they_are_flown():
    env = played(0, scenario="paper")
    assert env.picture.picture.shading() == [(49.5, 55.5)]
    straight = played(0, scenario="paper", acceleration=(0.0, 0.0))
    assert straight.picture.picture.shading() == []


def test_ellipse_axes_of_a_turned_covariance():
    angle = numpy.radians(30.0)
    turn = numpy.array([[numpy.cos(angle), -numpy.sin(angle)], [numpy.sin(angle), numpy.cos(angle)]])
    large, small, direction = ellipse_axes(turn @ numpy.diag([9.0, 4.0]) @ turn.T)
    assert (large, small) == pytest.approx((3.0, 2.0), rel=1e-12)
    assert direction % 180.0 == pytest.approx(30.0, abs=1e-9)


@pytest.mark.parametrize(
    ("limits", "low", "high", "expected"),
    [
        ((-4.0, 4.0), -3.0, 4.0, (-4.0, 4.0)),
        ((-4.0, 4.0), -4.1, 0.0, (-8.0, 8.0)),
        ((0.0, 500.0), 0.0, 1001.0, (0.0, 2500.0)),
        ((0.0, 500.0), 0.0, 2501.0, (0.0, 5000.0)),
        ((-1.0, 1.0), 0.0, 700.0, (-1000.0, 1000.0)),
        ((0.0, 1.0), -5.0, 0.5, (0.0, 1.0)),
    ],
)
def test_limits_grow_on_a_ladder(limits, low, high, expected):
    assert rendering.widen_limits(limits, low, high) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("face", "many"), [(TaskEnv, {}), (TaskVectorEnv, {"num_envs": 2})])
def test_render_before_reset_and_without_a_mode(face, many):
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset before the first render"):
        face(ID, **many, render_mode="rgb_array").render()
    env = face(ID, **many)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None
    with pytest.raises(ValueError, match="rgb_array"):
        face(ID, **many, render_mode="rgb_aray")


def test_human_mode_names_what_is_missing_and_no_mode_needs_no_library():
    code = (
        "import filtergym, gymnasium, sys, warnings\n"
        f"gymnasium.make({ID!r}).reset(seed=0)\n"
        "assert 'matplotlib' not in sys.modules\n"
        "with warnings.catch_warnings(record=True) as caught:\n"
        "    warnings.simplefilter('always')\n"
        f"    env = gymnasium.make({ID!r}, render_mode='human', horizon=3)\n"
        "    env.reset(seed=0)\n"
        "    env.step(env.action_space.sample())\n"
        "    assert env.render() is None\n"
        "    env.close()\n"
        "[text] = [str(w.message) for w in caught if 'human' in str(w.message)]\n"
        "assert 'needs a display' in text and 'rgb_array' in text, text\n"
    )
    environment = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    subprocess.run([sys.executable, "-c", code], check=True, env={**environment, "MPLBACKEND": "agg"})


def test_human_mode_goes_on_where_a_window_cannot_be_opened(monkeypatch):
    pyplot = pytest.importorskip("matplotlib.pyplot")

    def refuse(*_, **__):
        raise RuntimeError("no display name")

    monkeypatch.setattr(rendering, "_missing_display", lambda: "")
    monkeypatch.setattr(pyplot, "figure", refuse)
    env = TaskEnv(ID, render_mode="human", horizon=3)
    with pytest.warns(UserWarning, match="cannot open a window .no display name.; check DISPLAY"):
        env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.render() is None


def test_human_mode_draws_each_step_into_one_window(monkeypatch):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")  # stands in for a window: it has a figure manager, and nothing is shown
    monkeypatch.setattr(rendering, "_missing_display", lambda: "")
    monkeypatch.setattr(rendering.Figure, "show", lambda figure: None)
    already = set(pyplot.get_fignums())
    env, other = (TaskEnv(ID, render_mode="human", horizon=3) for _ in range(2))
    env.picture.frames_per_second = other.picture.frames_per_second = 1000.0
    env.reset(seed=0)
    other.reset(seed=1)
    assert len(set(pyplot.get_fignums()) - already) == 2
    env.step(env.action_space.sample())
    assert env.render() is None
    shown = env.picture._panels[0].lines[0].get_xdata()
    assert len(shown) == 1
    # The user closes a window: the episode goes on.
    pyplot.close(env.picture._figure)
    env.step(env.action_space.sample())
    env.close()
    other.close()
    assert set(pyplot.get_fignums()) == already


def test_animation_is_a_small_looping_file(tmp_path):
    from PIL import Image

    frames = episode_frames(
        task_class(ID), "imm", competitor(ID, "imm"), "paper", seed=3, every=5, horizon=21
    )
    assert len(frames) == 6  # the reset, scans 5, 10, 15, 20, and the last
    path = tmp_path / "new" / "imm.gif"
    write_animation(frames, path)
    assert [p.name for p in path.parent.iterdir()] == ["imm.gif"]
    with Image.open(path) as image:
        assert image.n_frames == 6
        assert image.size == (960, 608)
        assert image.info["loop"] == 0
    with pytest.raises(ValueError, match="it has no estimates"):
        episode_frames(task_class(ID), "known-input-bound", competitor(ID, "known-input-bound"))


@pytest.mark.parametrize(
    ("id", "name"),
    [
        (ID, "imm-smoother"),  # in a plane
        ("filtergym/RadarEsmTracking-v0", "ideal"),  # over time
        ("filtergym/UavAutopilot-v0", "gust-imm"),  # in a closed loop
    ],
)
def test_estimators_smoothers_and_references_are_drawn(id, name, monkeypatch):
    """What is drawn are the estimates of the same episode in an evaluation."""
    drawn = []
    monkeypatch.setattr(
        estimate_picture.EstimatePicture,
        "draw",
        lambda self, history, state: drawn.append({key: values.copy() for key, values in history.items()}),
    )
    dataset = evaluate(id, [name], None, 2, horizon=7, decision_interval=1, tracks=True)
    seed = int(dataset["episode_seed"].values[1])
    keywords = {"horizon": 7, "decision_interval": 1}
    frames = episode_frames(task_class(id), name, competitor(id, name), None, seed=seed, every=3, **keywords)
    assert len(frames) == 3  # measurements 3, 6, and the last
    assert frames[0].size == (960, 608)
    own = dataset.isel(policy=0, episode=1)
    first = str(own["component"].values[0])
    for key, expected in (
        (f"error.{first}", own["error"].values[:, 0]),
        ("believed.0", own["estimate"].values[:, 0]),
        (f"sigma.{first}", numpy.sqrt(own["covariance"].values[:, 0, 0])),
    ):
        # The evaluation is compiled, where it can be; the picture is of NumPy.
        numpy.testing.assert_allclose(drawn[-1][key], expected, rtol=1e-6, atol=1e-6)


def test_skipped_steps_are_drawn_with_the_next_picture():
    """Stable-Baselines3's ``make_vec_env`` asks for a render mode always: it must cost nothing.

    In a scenario whose measurements take uniform numbers, too, with several measurements a decision.
    """
    env_id, short = "filtergym/LooselyCoupledNavigation-v0", {"horizon": 10, "decision_interval": 2}
    watched, unwatched = (
        gymnasium.make(env_id, scenario="outliers", render_mode="rgb_array", **short).unwrapped
        for _ in range(2)
    )
    for seed, steps in ((1, 1), (None, 2)):  # the second episode goes on with the first one's generator
        for env in (watched, unwatched):
            env.reset(seed=seed)
        watched.action_space.seed(0)
        for _ in range(steps):
            action = watched.action_space.sample()
            watched.step(action)
            unwatched.step(action)
            watched.render()
            assert unwatched._late._picture.count == 0
    numpy.testing.assert_array_equal(unwatched.render(), watched.render())
    assert unwatched._late._picture.count == 2 * watched.task.decision_interval
