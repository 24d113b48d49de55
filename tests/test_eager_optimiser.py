"""Optimisers without torch's compiler: the same numbers, and no compiler."""

import subprocess
import sys

import pytest

torch = pytest.importorskip("torch")

DESCENT = """
import sys
import torch
from filtergym.agents.eager_optimiser import exclude_from_compilation, step_eagerly

def descend(eagerly):
    torch.manual_seed(0)
    layer = torch.nn.Linear(3, 2)
    if eagerly:
        exclude_from_compilation()
    optimiser = torch.optim.Adam(layer.parameters(), lr=1e-2)
    if eagerly:
        step_eagerly(optimiser)
    for k in range(20):
        optimiser.zero_grad()
        (layer(torch.full((4, 3), 0.1 * k)) ** 2).sum().backward()
        optimiser.step()
        optimiser.load_state_dict(optimiser.state_dict())
    return layer.weight.detach()

own = descend(True)
print("torch._dynamo" in sys.modules)
if "own" in sys.argv:
    print(torch.equal(own, descend(False)))
"""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), ["False"]),
        # Importing the compiler takes seconds.
        pytest.param(("own",), ["False", "True"], marks=pytest.mark.slow),
    ],
)
def test_no_compiler_and_the_same_bits(words, expected):
    """In a process of its own, where nothing else has imported the compiler; torch's own optimiser comes second."""
    if not hasattr(torch.optim.Adam.step, "__wrapped__"):
        pytest.skip("this version of torch names its parts otherwise, and imports its compiler")
    found = subprocess.run(
        [sys.executable, "-c", DESCENT, *words], capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == expected
