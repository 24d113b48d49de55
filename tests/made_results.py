"""Results as a benchmark makes them, of a few episodes."""

from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.curves import curves_of

import filtergym
from filtergym.reports.benchmark import result_of


def results_of(id, names, scenario, episodes, **options):
    """Return the result of some competitors; shipped agents among them count as learned."""
    dataset = filtergym.evaluate(id, names, scenario, episodes, drawn_episodes=1, **options)
    records, curves = filtergym.tidy_records(dataset), curves_of(dataset)
    return result_of(problem_of(id), dataset, records, curves, pretrained_agents(id))
