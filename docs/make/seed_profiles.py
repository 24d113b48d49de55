"""Scores of training runs over several environments: interquartile means and performance profiles.

After R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, Deep Reinforcement Learning at the Edge
of the Statistical Precipice, NeurIPS 2021, section 4, whose library is rliable. Let ``x[m, n]`` be the score of run n
of ``N[m]`` in environment m of M. A run has the weight

    w[m, n] = 1 / (M N[m])                                                                                (1)

so that every environment counts the same, whatever number of runs it has. F is the weighted distribution function of
the scores. Interquartile mean and performance profile are

    IQM = 2 integral from 1/4 to 3/4 of F^-1(u) du,   P(tau) = sum over m, n of w[m, n] [x[m, n] > tau]   (2)

With equal numbers of runs P is that of the paper, and so is the IQM where four divides the number of all runs;
elsewhere rliable rounds the number of runs that it leaves out. Intervals are 95 % percentile intervals of the
bootstrap that resamples the runs within each environment (stratified). They are over training seeds only: all runs meet
the same episodes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy
from pictures import draw_profiles
from records import ResultRecord
from sentence_numbers import Number

from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import bare_name
from filtergym.evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate, percentile_interval
from filtergym.papers.grid import markdown_table
from filtergym.reports.tables.terminal_tables import with_interval

RESAMPLES = 10_000
Scores = Mapping[str, Mapping[str, numpy.ndarray]]
"""Algorithm -> environment -> score of each of its runs, ``(runs,)``."""


def recorded_scores(records: Sequence[ResultRecord], algorithms: Sequence[str] = ()) -> Scores:
    """Return scores of training runs by algorithm and environment, for environments in which all algorithms have runs.

    Agents are not distinguished by a gate or by a policy that they correct.

    The scores are those of the first scenario of a record, the training distribution.

    Raises:
        ValueError: if there is no such algorithm, or no environment that all of them have.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for record in records:
        data = record.data
        environment, names = bare_name(data["environment"]), {name: own for name, own, *_ in data["runs"]}
        reference = problem_of(data["environment"]).baselines.score_reference
        [(_, numbers), *_] = data["scenarios"].items()
        for name, statistic, against, metric, _, value, *_ in numbers:
            if (statistic, against, metric) == ("run", reference, "score") and value is not None:
                of_algorithm = found.setdefault(names[name].split()[0], {})
                of_algorithm.setdefault(environment, []).append(value)
    chosen = list(algorithms) or sorted(found)
    for name in chosen:
        if name not in found:
            raise ValueError(f"no training runs of {name!r}: there are {', '.join(sorted(found))}")
    common = (
        [name for name in found[chosen[0]] if all(name in found[own] for own in chosen)] if chosen else []
    )
    if not common:
        raise ValueError(f"no environment has training runs of all of {', '.join(chosen)}")
    return {own: {name: numpy.array(found[own][name]) for name in common} for own in chosen}


def run_weights(counts: Sequence[int], resamples: int = RESAMPLES) -> numpy.ndarray:
    """Return the weights of runs (1), then those of each bootstrap resample, ``(1 + resamples, runs)``."""
    each = [Bootstrap(count, resamples, seed).weights for seed, count in enumerate(counts)]
    return numpy.concatenate(each, axis=1) / len(counts)


def interquartile_mean(scores: numpy.ndarray, weights: numpy.ndarray) -> numpy.ndarray:
    """Return the interquartile mean (2) of scores under each row of weights, ``(n,)``.

    The weights ``(n, runs)`` sum to one in a row.
    """
    order = numpy.argsort(scores)
    ends = numpy.cumsum(weights[:, order], axis=1)
    inside = numpy.clip(ends, 0.25, 0.75) - numpy.clip(ends - weights[:, order], 0.25, 0.75)
    found: numpy.ndarray = 2.0 * inside @ scores[order]
    return found


def performance_profile(
    scores: numpy.ndarray, weights: numpy.ndarray, limits: numpy.ndarray
) -> numpy.ndarray:
    """Return the weighted share of runs with a score above each limit (2), ``(n, limits)``."""
    found: numpy.ndarray = weights @ (scores[:, None] > limits)
    return found


def interquartile_table(scores: Scores) -> str:
    """Return a table in Markdown: interquartile mean of every algorithm with interval, over its environments."""
    rows = []
    for name, own in scores.items():
        weights = run_weights([len(values) for values in own.values()])
        mean = IntervalEstimate(*percentile_interval(interquartile_mean(_pooled(own), weights)).tolist())
        runs = ", ".join(str(len(values)) for values in own.values())
        rows.append((mean.value, [f"`{name}`", runs, with_interval(Number(*mean))]))
    environments = ", ".join(next(iter(scores.values())))
    head = ["algorithm", f"runs in {environments}", "interquartile mean of the score"]
    return "\n".join(markdown_table(head, [row for _, row in sorted(rows, key=lambda each: -each[0])]))


def profile_figure(scores: Scores) -> Any:
    """Return a figure with each algorithm's performance profile: share of runs above each score."""
    everything = numpy.concatenate([_pooled(own) for own in scores.values()])
    limits = numpy.linspace(min(0.0, everything.min()), max(1.0, everything.max()), 401)
    profiles = {}
    for name, own in scores.items():
        weights = run_weights([len(values) for values in own.values()])
        profiles[name] = percentile_interval(performance_profile(_pooled(own), weights, limits))
    environments = list(next(iter(scores.values())))
    return draw_profiles(limits, profiles, f"Training runs in {', '.join(environments)}")


def _pooled(own: Mapping[str, numpy.ndarray]) -> numpy.ndarray:
    return numpy.concatenate([*own.values()])
