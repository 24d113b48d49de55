"""Results as a benchmark makes them, of a few episodes."""

import re

import filtergym
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.running.curves import curves_of
from filtergym.evaluation.running.summary import Evaluation
from filtergym.evaluation.storage.dataset import keywords_of
from filtergym.names import find_competitors
from filtergym.reports.tables.benchmark import result_of
from filtergym.reports.tables.worst import find_worst


def without_times(file):
    text = file.read_text(encoding="utf-8")
    kept, count = re.subn(
        r'("metric": "nanoseconds"[^{}]*?"value": )[^,]+, "low": [^,]+, "high": [^,]+', r"\1null", text
    )
    assert count
    return re.sub(r'("nanoseconds\w*": \[\["policy"\], \{"shape": \[\d+\], "numbers": \[)[^\]]+', r"\1", kept)


def results_of(id, names, scenario, episodes, **options):
    """Return the result of some competitors; shipped agents among them count as learned."""
    dataset = filtergym.evaluate(id, names, scenario, episodes, drawn_episodes=1, **options)
    records, curves = filtergym.tidy_records(dataset), curves_of(dataset)
    problem = problem_of(id)
    paper = dataset.attrs["paper"]
    costs = {paper: dataset["cost"].sel(policy=paper).values.mean(axis=1)}
    about = dataset.attrs
    experiment = problem.experiment(
        scenario, episodes, about["seed"], about["split"], keywords=keywords_of(dataset)
    )
    evaluation = Evaluation(dataset, records, curves, costs)
    worst = find_worst(experiment, evaluation, find_competitors(problem, names), [paper])
    return result_of(problem, evaluation, pretrained_agents(id), worst)
