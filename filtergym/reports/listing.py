"""What there is: an environment with its paper, controls, scenarios and competitors, in lines for the terminal."""

from collections.abc import Iterator

from ..agents.named_policies import pretrained_agents
from ..baselines.problem import Problem
from ..compiler.library import fastest
from ..compiler.native import processor
from ..envs.contract.task import Task
from ..envs.engine.backend import make_model
from ..envs.engine.catalogue import USER_TASKS, parameter_names
from ..envs.engine.compiled import AVAILABLE


def _backend(cls: type[Task]) -> str:
    """What computes an environment's steps, and where the exponentials of compiled ones come from."""
    compiled = AVAILABLE
    if cls.id in USER_TASKS:  # those of this package can all be traced
        compiled = make_model(cls, backend="auto").backend == "compiled"
    return f"compiled (functions of {fastest(processor()[1]).name})" if compiled else "numpy"


def environment_lines(problem: Problem) -> Iterator[str]:
    """Describe an environment; the first line is its id."""
    cls, known = problem.task, problem.baselines
    yield problem.name
    yield f"  {(cls.__doc__ or '').strip().partition(chr(10))[0]}"
    if cls.paper_source:
        yield f"  paper:       {cls.paper_source}"
    rows = {
        "controls": [f"{c} (default)" if c == cls.controls[0] else c for c in cls.controls],
        "policies": list(known.policies),
        "estimators": list(known.estimators),
        "tuned": problem.tuned_policies,
        "learned": pretrained_agents(cls.id),
        "parameters": parameter_names(cls),
    }
    for title, names in rows.items():
        if names:
            yield f"  {title + ':':<12} {', '.join(names)}"
    yield f"  {'backend:':<12} {_backend(cls)}"
    if known.smoothers:
        yield f"  smoothers:   {', '.join(known.smoothers)} (not causal: they use later measurements)"
    for title, table in (("references", known.references), ("bounds", known.bounds)):
        if table:
            yield f"  {title}:"
        for name, maker in table.items():
            yield f"    {name:<22} knows {maker.knows}"
    yield "  scenarios:"
    for scenario in cls.scenarios.values():
        role = " (default)" if scenario.name == cls.default_scenario else ""
        role += " (training)" if scenario.training else ""
        yield f"    {scenario.name:<22} {scenario.description}{role}"
