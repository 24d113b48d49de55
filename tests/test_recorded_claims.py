"""What the pages say of results, read from the records of the benchmark that the pages show."""

import pytest
from records import read_record

from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import bare_name, catalogue
from filtergym.names import ranked_names

pytestmark = pytest.mark.claims
COMPETE = ("policy", "estimator")
"""Kinds that know neither the truth nor the future."""
AS_MODELLED = ("ManeuveringTarget", "LooselyCoupledNavigation", "RadarEsmTracking")
"""Environments whose reference knows the world as it is, in every scenario."""


def recorded_scenarios(name):
    """Competitors of every scenario in the record of an environment, each with its kind and metrics."""
    scenarios = read_record(f"benchmark/{name}").data["scenarios"]
    return {scenario: found["competitors"] for scenario, found in scenarios.items()}


def test_no_competitor_is_significantly_better_than_the_reference(env_id):
    """A score of one is the reference; its interval is that of paired differences over the same episodes."""
    scenarios = recorded_scenarios(bare_name(env_id))
    assert list(scenarios) == list(catalogue()[env_id].scenarios)
    judged = 0
    for scenario, competitors in scenarios.items():
        for name, found in competitors.items():
            _, low, _ = found["metrics"].get("score", (None, None, None))
            if found["kind"] in COMPETE and low is not None:
                judged += 1
                assert low <= 1.0, (scenario, name, found["metrics"]["score"])
    assert judged > len(scenarios)


@pytest.mark.parametrize("name", AS_MODELLED)
def test_the_covariance_of_the_reference_is_as_large_as_its_errors(name):
    reference = problem_of(f"filtergym/{name}-v0").baselines.score_reference
    for scenario, competitors in recorded_scenarios(name).items():
        _, low, high = competitors[reference]["metrics"]["anees state"]
        assert low < 1.01, scenario
        assert high > 0.99, scenario


def test_tuned_estimators_of_maneuvering_targets_come_in_their_order():
    competitors = recorded_scenarios("ManeuveringTarget")["random"]
    costs = {
        name: found["metrics"]["cost"][0] for name, found in competitors.items() if name.endswith("-tuned")
    }
    semi_markov = costs.pop("semi-markov-vague-tuned")
    few = [costs.pop(name) for H in (15, 9, 5, 3) if (name := f"semi-markov-{H}-tuned") in costs]
    assert few == sorted(few)
    turning = costs.pop("kalman-imm-turn-tuned")
    assert semi_markov < 0.95 * turning
    assert turning < min(costs.values())
    for name, cost in costs.items():
        assert cost <= competitors[name.removesuffix("-tuned")]["metrics"]["cost"][0], name


def test_the_crash_test_has_a_row_of_everybody_who_is_shipped(env_id):
    rows = [row[0] for row in read_record(f"stress/{bare_name(env_id)}").data["rows"]]
    assert sorted(rows) == sorted(ranked_names(problem_of(env_id)))
