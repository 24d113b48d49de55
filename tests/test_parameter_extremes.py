"""Parameters at the ends of their limits, alone and together: finite numbers, or one sentence with the reason.

A few combinations here; every end alone and 2000 combinations of each environment by
``python tests/test_parameter_extremes.py 2000``; a second number is the seed, and names of environments may follow.
"""

import sys
import types
import typing
import warnings

import numpy as np
import pytest
from models import make_model

from filtergym.envs.contract.parameters import field_limits
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.engine.lanes import Lanes
from filtergym.envs.engine.reward import REWARDS, reward_baseline
from filtergym.envs.engine.scenario_choice import find_scenario
from filtergym.envs.interface.step_report import step_report

ENDLESS = {float: (-1e6, -1e-6, 1e-6, 1e6), int: (1, 2, 300)}
"""Where a limit leaves a number open: extreme, and still sensible in some unit."""
DECISIONS = 12


def ends(number, limits):
    """Numbers at the ends of what limits allow."""
    closed = [limits.at_least, limits.at_most]
    beside = [(limits.above, 1e-6), (limits.below, -1e-6)]
    found = [*ENDLESS[number], *closed, *(end + step for end, step in beside if end is not None)]
    return sorted(
        number(value)
        for value in {v for v in found if v is not None}
        if (limits.above is None or value > limits.above)
        and (limits.at_least is None or value >= limits.at_least)
        and (limits.below is None or value < limits.below)
        and (limits.at_most is None or value <= limits.at_most)
    )


def extremes(hint, limits, value):
    """Values of a parameter at its ends, as long as the one that it has."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        inner = next(other for other in typing.get_args(hint) if other is not types.NoneType)
        return [None, *extremes(inner, limits, value)]
    if hint is bool:
        return [False, True]
    if hint is str:
        return list(limits.choices)
    if hint in ENDLESS:
        return ends(hint, limits)
    of = typing.get_args(hint)
    if not value or of[0] is str:
        return []
    if of[0] not in ENDLESS:
        rows = [extremes(of[0], limits, row) for row in value]
        return [tuple(choices[i % len(choices)] for choices in rows) for i in range(max(map(len, rows)))]
    if limits.ascending:
        low, *_, high = ends(of[0], limits)
        return [(low, low), (low, high), (high, high)]
    if limits.stochastic:
        return [tuple(float(i == k) for i in range(len(value))) for k in range(len(value))]
    return [
        (*value[:k], end, *value[k + count :])
        for end in ends(of[0], limits)
        for k, count in [(0, len(value)), *((k, 1) for k in range(len(value)))]
    ]


def table(cls, scenario):
    """Extremes of every parameter of an environment in a scenario."""
    parameters = cls.Parameters(**find_scenario(cls, scenario).parameters)

    def value(name):
        given = getattr(parameters, name)
        if given is None and name in ("sensor_sigmas", "initial_sigmas", "state_weights"):
            return parameters.value(name)  # UavAutopilot: the plant's own
        return given

    found = {n: extremes(*declared, value(n)) for n, declared in field_limits(cls.Parameters).items()}
    return {name: values for name, values in found.items() if values}


def actions(space, rng, step):
    """Actions of a step for three episodes: at the edges of the space, or within."""
    if hasattr(space, "n"):
        return rng.integers(space.n, size=3)
    edge = rng.choice([space.low, space.high], size=3)
    return edge if step % 3 == 0 else rng.uniform(space.low, space.high, edge.shape)


def finding(env_id, keywords, kind, rng):
    """Run three episodes with these keywords: "" if all is well, "refused: ..." or what went wrong."""
    try:
        model = make_model(env_id, **{"horizon": 60, "decision_interval": 1, **keywords})
        lanes = Lanes(model, 3, reward_baseline(kind, model))
    except np.linalg.LinAlgError as error:
        return f"LinAlgError: {error}"
    except ValueError as error:
        return f"refused: {error}"
    for lane in range(3):
        lanes.seed(lane, np.random.default_rng(lane))
    lanes.restart()
    wrong, report = [], step_report(kind, episode=True)

    def check(state, paid):
        P = np.moveaxis(model.covariance(state), -1, 0)
        found = {
            "error": model.error(state),
            "cost": model.cost(state),
            "reward": paid,
            "covariance": P,
        }
        wrong.extend(name for name, values in found.items() if not np.isfinite(values).all())
        if not wrong:
            sigma = np.sqrt(np.maximum(np.einsum("nii->ni", P), 1e-300))
            if not (np.einsum("nii->ni", P) > 0.0).all():
                wrong.append("a variance of zero")
            lowest = np.linalg.eigvalsh(P / sigma[:, :, None] / sigma[:, None, :]).min()
            if lowest < -1e-9:
                wrong.append(f"correlations with an eigenvalue of {lowest:.2g}")

    last = min(DECISIONS, lanes.decisions_per_episode)
    for step in range(last + 1):
        shown = np.isfinite(lanes.observe()).all(axis=0)
        wrong.extend(f"observation {model.fields[i].name}" for i in np.flatnonzero(~shown))
        if wrong:
            return f"step {step}: {', '.join(wrong)}"
        action = actions(model.action_space, rng, step)
        if step < last:
            for own, paper in lanes.decide(action, report):
                check(own.episode, own.reward if paper is None else own.reward - paper.reward)
    return ""


def combinations(cls, count, seed):
    """Random controls, scenarios and one to six parameters at their ends, each with a reward."""
    rng = np.random.default_rng(seed)
    tables = {scenario: table(cls, scenario) for scenario in cls.scenarios}
    for i in range(count):
        scenario = str(rng.choice(list(tables)))
        names = rng.choice(list(tables[scenario]), size=rng.integers(1, 7), replace=False)
        chosen = {str(n): tables[scenario][n][rng.integers(len(tables[scenario][n]))] for n in names}
        yield (
            {"control": str(rng.choice(cls.controls)), "scenario": scenario, **chosen},
            REWARDS[i % len(REWARDS)],
        )


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_extreme_parameters_are_finite_or_refused(env_id):
    rng = np.random.default_rng(0)
    for keywords, kind in combinations(catalogue()[env_id], 12, seed=1):
        outcome = finding(env_id, keywords, kind, rng)
        assert not outcome or outcome.startswith("refused: "), f"{keywords}: {outcome}"


@pytest.mark.parametrize(
    ("environment", "parameters"),
    [
        ("UavAutopilot", {"actuator_disturbance": 0.0}),
        ("UavAutopilot", {"lift_incidence": -1e6}),
        ("UavAutopilot", {"sensor_sigmas": (0.5, 1e-6, 0.5), "wide_band_scale": 1e6}),
        (
            "UavAutopilot",
            {"mass": 1e-6, "chord": 1e-6}
            | dict.fromkeys(("moment_disturbance", "gust_sigma", "actuator_disturbance"), 1e-6),
        ),
        ("ManeuveringTarget", {"glint_factor": 1e6}),
        ("ManeuveringTarget", {"coloured_sigma": (0.0, 1e5)}),
        ("UavAutopilot", {"moment_rate": 1e6}),
        ("UavAutopilot", {"sensor_coloured": (0.0, 1e6)}),
        (
            "UavAutopilot",
            {
                "scenario": "sensor-degradation",
                "wing_area": 1e-6,
                "control_weight": 1e6,
                "state_weights": (0.0, 0.02, 1.0, 1e6, 0.0),
                "mass": 1e-6,
                "sensor_sigmas": (1e-6, 1.0, 0.5),
            },
        ),
        ("LooselyCoupledNavigation", {"sampling_interval": 1e5}),
        ("LooselyCoupledNavigation", {"sampling_interval": 1e3, "coloured": 1e5}),
        ("LooselyCoupledNavigation", {"sampling_interval": 1e3, "drift_factor": (1e6, 1e6)}),
        ("LooselyCoupledNavigation", {"sampling_interval": 1e3, "receiver_factor": (1e-6, 1e-6)}),
        ("TightlyCoupledNavigation", {"strength": (0.0, 1e6)}),
        ("TightlyCoupledNavigation", {"pseudorange_sigma": 1e-6}),
        ("TightlyCoupledNavigation", {"singer_sigma": 1e6}),
        ("TightlyCoupledNavigation", {"gravity": 1e6, "initial_attitude_sigma": 180.0}),
        ("TightlyCoupledNavigation", {"reset_acceleration_sigma": 1e6}),
        ("TightlyCoupledNavigation", {"increment_sigma": 1e6, "initial_velocity_sigma": 1e6}),
        ("TightlyCoupledNavigation", {"frequency_walk_density": 1e6, "rate_sigma": 1e-6}),
    ],
)
def test_what_no_filter_can_answer_is_refused(environment, parameters):
    with pytest.raises(ValueError, match=r"must") as caught:
        make_model(environment, **parameters)
    assert caught.type is ValueError, "not one of NumPy or SciPy, which names no parameter"


@pytest.mark.parametrize(("control", "intensity"), [("mode", 0.0), ("weights", 1e-300)])
def test_a_scheme_that_knows_no_noise_is_not_certain(control, intensity):
    """Of LooselyCoupledNavigation, whose plain scheme knows the white noise alone."""
    id, keywords = "filtergym/LooselyCoupledNavigation-v0", {"control": control, "white_intensity": intensity}
    assert not finding(id, keywords, "log-likelihood", np.random.default_rng(0))


def main(count, seed="0", *chosen):
    """Try every end alone, then random combinations drawn with the seed, and print what fails."""
    warnings.simplefilter("ignore")
    for env_id, cls in catalogue().items():
        if chosen and not any(name in env_id for name in chosen):
            continue
        alone = [
            ({"control": control, name: value}, "log-likelihood")
            for name, values in table(cls, None).items()
            for value in values
            for control in {cls.controls[0], cls.controls[-1]}
        ]
        cases = [*alone, *combinations(cls, int(count), int(seed))]
        rng = np.random.default_rng(int(seed))
        refused = failed = 0
        for keywords, kind in cases:
            try:
                outcome = finding(env_id, keywords, kind, rng)
            except Exception as error:
                outcome = f"{type(error).__name__}: {error}"
            refused += outcome.startswith("refused: ")
            if outcome and not outcome.startswith("refused: "):
                failed += 1
                print(f"{env_id} {keywords}: {outcome}", flush=True)
        print(
            f"{env_id}: {len(cases)} tried ({len(alone)} alone), {refused} refused, {failed} failed",
            flush=True,
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
