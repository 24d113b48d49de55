"""Learned competitors against the best classical one of the same time, paired on the same episodes, in Markdown.

    python benchmarks/front_pairs.py

Who is compared with whom follows from the table of time budgets in the documentation: on either side the one that costs
least on the training distribution in so many nanoseconds. Differences are geometric means of the episodes' ratios, with
95 % bootstrap intervals; beside them the ratio of the means.
"""

import argparse

from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.papers.grid import markdown_table

import filtergym

PAIRS: dict[str, tuple[int, tuple[tuple[str, str], ...]]] = {
    "LooselyCoupledNavigation": (
        1200,
        (
            ("bptt-linear", "augmented-sage-husa"),
            ("bptt-small", "augmented-sage-husa"),
            ("kalman-net", "augmented-sage-husa"),
        ),
    ),
    "ManeuveringTarget": (
        5000,
        (
            ("bptt-linear", "adaptive-rearm-tuned"),
            ("bptt-small", "adaptive-rearm-tuned"),
            ("bptt-small", "kalman-imm-turn-tuned"),
            ("kalman-net", "kalman-imm-turn-tuned"),
        ),
    ),
    "RadarEsmTracking": (
        5000,
        (
            ("bptt-small", "forgetting-joint-type-tuned"),
            ("kalman-net", "forgetting-joint-type-tuned"),
            ("bptt", "forgetting-joint-type-tuned"),
        ),
    ),
    "UavAutopilot": (
        1000,
        (
            ("bptt-linear", "sage-husa-tuned"),
            ("bptt-small", "gust-imm-tuned"),
            ("kalman-net", "gust-imm-tuned"),
            ("kalman-net", "level-bank"),
        ),
    ),
}
"""Episodes, and learned and classical competitors, by environment."""


def main() -> None:
    """Evaluate, and print the table."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rows = []
    for name, (episodes, pairs) in PAIRS.items():
        names = sorted({each for pair in pairs for each in pair})
        results = filtergym.evaluate(f"filtergym/{name}-v0", names, episodes=episodes, seed=0)
        cost = {each: results["cost"].sel(policy=each).values.mean(axis=1) for each in names}
        bootstrap = Bootstrap(episodes)
        for learned, classical in pairs:
            found = bootstrap.geometric_difference(cost[learned], cost[classical])
            means = cost[learned].mean() / cost[classical].mean() - 1.0
            difference = " ".join(
                (f"{100.0 * found.value:+.1f}", f"[{100.0 * found.low:+.1f}, {100.0 * found.high:+.1f}]")
            )
            rows.append([name, f"`{learned}`", f"`{classical}`", difference, f"{100.0 * means:+.1f}"])
    header = ["environment", "learned", "classical", "learned less classical, % of the cost", "means, %"]
    print("\n".join(markdown_table(header, rows)))


if __name__ == "__main__":
    main()
