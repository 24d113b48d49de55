"""The paper's claims and open questions with verdicts, and the tables of the report."""

import math
from typing import Any

import numpy

from ..grid import Grid
from ..quantities import Quantity, mean, means, quantity
from ..reproduction import Statement, verdict_if, verdict_of
from .experiment import (
    DRIFT,
    GAINS,
    NAMES,
    PARAMETERS,
    STEP,
    Results,
    closed_form,
    exact_root_mean_squares,
    riccati_agreement,
)

DIFFERENCES = {
    "process": "estimate - process", "reference": "estimate - reference", "departure": "process - reference",
}  # fmt: skip


def rms_errors(r: Results) -> tuple[dict[str, Quantity], dict[str, Quantity]]:
    """Return the root mean square errors of example (a), and of example (b), by name."""
    a = {name: quantity(numpy.sqrt(means(r.example.squares[name]))) for name in DIFFERENCES}
    return a, {name: quantity(numpy.sqrt(squares)) for name, squares in r.squares.items()}


METHOD = "{r.episodes} episodes of `paper`, common noise, 2.5 to 5 s"
CLAIMS = (
    Statement(
        "1",
        "The estimate follows the random process X and may depart strongly from the reference (Fig. 2).",
        "RMS to the process {a[process]:.4f} unit, to the reference {a[reference]:.4f}; process to reference "
        "{a[departure]:.4f}. Orthogonality: mean product {product:.4f} (0 expected), so the departure is Theta "
        "- R: {theory[reference]:.4f} in theory",
        "{r.episodes} runs of example (a), 2.5 to 5 s",
        lambda q: verdict_if(
            q.a["process"].high < q.a["reference"].low and q.product.low <= 0.0 <= q.product.high
        ),
    ),
    Statement(
        "2",
        "In a digital complex the filter must be a discrete algorithm.",
        "a sampled filter approaches the covariance (5) only at order {agreement.order:.2f} in the step: at "
        f"{STEP:g} s its RMS is {{theory[process]:.4f}} after the update, that of (5) is {{continuous:.4f}}",
        "exact recursions; closed form of (5)",
        lambda q: verdict_if(0.9 < q.agreement.order < 1.1),
    ),
    Statement(
        "3",
        "In fusion the estimate stays near the reference although the INS departs and GNSS is noisy: systematic "
        "INS errors are compensated (Figs. 4, 5).",
        "RMS: INS {b[ins-only]:.3f} m, GNSS {b[gnss-only]:.3f} m, plain scheme {b[plain-reduced]:.4f} m. Of "
        f"a drift of {DRIFT:g} m/s the plain scheme keeps {{kept[plain-white]:.3f}} m (Ge = 0.04; beta / K = "
        "{held[white]:.3f}) or {kept[plain-reduced]:.3f} m (Ge = 0.36; {held[reduced]:.3f}): attenuated, "
        "not removed. The augmented scheme keeps {kept[augmented]:.3f} m",
        f"{METHOD}; {{r.drifting_episodes}} episodes of 20 s with a drift of {DRIFT:g} m/s, mean of the last "
        "measurement",
        lambda q: verdict_of(
            (
                attenuated := q.b["plain-reduced"].high < min(q.b["ins-only"].low, q.b["gnss-only"].low),
                attenuated and q.kept["plain-reduced"].low <= 0.0,
            )
        ),
    ),
    Statement(
        "4",
        "The input noises are partly smoothed.",
        "GNSS error over the error of the plain scheme: {smoothing:.2f}. Of the receiver's {sample:.2f} m a sample, "
        "{receiver:.3f} m are left; the white INS noise, which alone would grow without limit, is held at {ins:.3f} m",
        f"{METHOD}; shares from (6)",
        lambda q: verdict_if(q.smoothing.low > 1.0),
    ),
    Statement(
        "5",
        "Which gain? The paper gives (4), (5) and no numbers.",
        "white part only, K = {gains[white]:.2f} 1/s: {b[plain-white]:.4f} m; coloured part reduced to white, K = "
        "{gains[reduced]:.2f}: {b[plain-reduced]:.4f} m; best constant, K = {gains[best]:.2f}: "
        "{b[best-constant]:.4f} m. The plain scheme's own covariance does not contain the drift",
        METHOD,
    ),
    Statement(
        "6",
        "Is the time-varying gain of (5) better than its settled value?",
        "not where the model leaves the drift out: with Ge = 0.04 the Riccati gain is {varying_white:.2%} worse "
        "({b[time-varying-white]:.4f} m), because it starts low while the error already grows; with Ge = 0.36 the "
        "change is {varying:.2%}",
        f"{METHOD}, paired",
    ),
    Statement(
        "7",
        "How much does the paper's scheme lose to a filter that estimates the rate errors?",
        "augmented: {b[augmented]:.4f} m, {augmented:.1%} against the plain scheme; a gain steered by an augmented "
        "filter inside the policy: {b[augmented-gain]:.4f} m",
        f"{METHOD}, paired",
    ),
    Statement(
        "8",
        "Does the augmented scheme have a steady state?",
        "no: {agreement.refusal}",
        "condition on the algebraic Riccati equation",
    ),
)
"""The paper's claims, and questions that it leaves open."""


def quantities(r: Results) -> dict[str, Any]:
    """Return the quantities that the claims' texts and verdicts contain, by name."""
    a, b = rms_errors(r)
    p, gains = PARAMETERS, dict(zip(("white", "reduced", "best"), GAINS.values(), strict=True))

    def change(name: str, other: str) -> Quantity:
        """Return the relative change of a root mean square error to another one, over paired episodes."""
        return quantity(numpy.sqrt(r.squares[name] / r.squares[other]) - 1.0)

    return {
        "r": r,
        "a": a,
        "b": b,
        "product": mean(r.example.squares["product"]),
        "theory": {name: math.sqrt(square) for name, square in r.example.theory.items()},
        "agreement": riccati_agreement(),
        "continuous": math.sqrt(closed_form([5.0])[0]),
        "kept": {name: quantity(samples[:, -1]) for name, samples in r.drift.items()},
        "gains": gains,
        "held": {name: DRIFT / gain for name, gain in gains.items()},
        "smoothing": quantity(numpy.sqrt(r.squares["gnss-only"] / r.squares["plain-reduced"])),
        "sample": math.sqrt(p.receiver_variance),
        "receiver": math.sqrt(gains["reduced"] * p.receiver_intensity / 2.0),
        "ins": math.sqrt(p.white_intensity / (2.0 * gains["reduced"])),
        "varying_white": change("time-varying-white", "plain-white"),
        "varying": change("time-varying", "plain-reduced"),
        "augmented": change("augmented", "plain-reduced"),
    }


def tables(r: Results) -> list[Grid]:
    """Return the report's tables: root mean squares measured and exact, and solutions of the Riccati equation."""
    a, b = rms_errors(r)
    theory, exact, agreement = r.example.theory, exact_root_mean_squares(), riccati_agreement()
    return [
        Grid(
            "Example (a): root mean square, 2.5 to 5 s, unit",
            ("difference", "measured", "exact"),
            [
                (label, f"{a[name]:.4f}", f"{math.sqrt(theory[name]):.4f}")
                for name, label in DIFFERENCES.items()
            ],
        ),
        Grid(
            "Example (b): root mean square error of position, 2.5 to 5 s, m",
            ("algorithm", "policy", "measured", "exact"),
            [
                (label, f"`{name}`", f"{b[name]:.4f}", f"{exact[name]:.4f}" if name in exact else "-")
                for name, label in NAMES.items()
            ],
        ),
        Grid(
            "The Riccati equation (5) three ways",
            ("pair", "largest relative difference"),
            [
                (
                    "exponential of the Hamiltonian matrix / closed form, example (a)",
                    f"{agreement.hamiltonian:.1e}",
                ),
                ("numerical integration / closed form, example (a)", f"{agreement.ode:.1e}"),
                ("exponential / numerical integration, augmented model", f"{agreement.matrix:.1e}"),
            ],
        ),
    ]
