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
print(torch.equal(own, descend(False)))
"""


def test_no_compiler_and_the_same_bits():
    """In a process of its own, where nothing else has imported the compiler; torch's own optimiser comes second."""
    if not hasattr(torch.optim.Adam.step, "__wrapped__"):
        pytest.skip("this version of torch names its parts otherwise, and imports its compiler")
    said = subprocess.run([sys.executable, "-c", DESCENT], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["False", "True"]
