"""A whole filter as one straight-line program for one measurement: state and measurement in, state and estimate out.

The traced code is the filter's own, the same that an evaluation runs. Numbers that do not affect the estimate are left
out of the state, and members that are always equal, as P[0, 1] and P[1, 0], are stored once.
"""

import copy
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import count as count_from
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ..baselines.table import Tunable
from ..baselines.tuned_values import TunedPolicy
from ..compiler import namespace
from ..compiler.functions import leaves, map_arrays
from ..compiler.namespace import NotTraceable, Traced
from ..compiler.program import Graph, ProgramResult, ProgramSteps, StraightLineProgram, program
from ..envs.contract.companions import array_meanings
from ..envs.contract.filter import Filter, FilterInput
from ..envs.contract.model import Model
from ..envs.contract.parameters import freeze
from ..envs.contract.task import Task, field_words
from ..evaluation.competitors.filters import as_filter
from ..evaluation.competitors.kinds import RANKED, Policy, RandomPolicy, kind_of, make_competitor
from ..evaluation.competitors.steered_filter import Decider, steer
from .parameters import (
    PARAMETER,
    Declaration,
    Declared,
    ParameterGraph,
    declaration,
    expressions,
    traced_functions,
    with_parameters,
)

if TYPE_CHECKING:
    from ..agents.learned_policy import LearnedPolicy

STATE, MEASUREMENT, ANSWER, INITIAL, ESTIMATE, SHOWN = range(6)
"""Numbers of the arguments of the programs ``start`` and ``update``."""
DERIVED, CONDITION = 7, 8
LIKELIHOODS = ("log_likelihood", "nis", "nis_degrees")
"""Names of the likelihoods that an exported filter returns beside its estimate, where it has them."""
FEEDBACK = "feedback"
"""Name of the part of an estimate that the closed loop feeds back, where it does not follow from the mean."""


class Member(NamedTuple):
    """A number of an array in a filter's input, state or estimate: array, shape, place, meaning."""

    name: str
    """Name of its array: the attributes that lead to it."""
    shape: tuple[int, ...]
    """Shape of its array, without axes of one."""
    place: int
    """Place in that array, row by row."""
    words: str
    """Meaning of its array, where its class documents it."""


class FreeParameters(NamedTuple):
    """Parameters of a filter that its user sets, and the program that derives its numbers from them."""

    declared: Sequence[Declared] = ()
    """Arrays in the order of the rows of the argument ``PARAMETER``."""
    derive: StraightLineProgram | None = None
    """Program from the parameters to the rows of the argument ``DERIVED``; None where none is free."""
    usual: Sequence[float] = ()
    """Values of the rows of ``DERIVED`` with the current parameters."""
    kept: int = 0
    """Number of these rows that are also the last rows of the state: ``update`` reads them and leaves them
    unchanged.
    """
    stated: range = range(0)
    """Rows of ``DERIVED`` that may differ from the Python filter's in the last bits, since a library computes them."""
    condition: StraightLineProgram | None = None
    """Program from the parameters to one result, whether the programs hold for them; None: for any within
    the limits.
    """
    constant: Sequence[str] = ()
    """Names of declared parameters that keep the values of the trace."""

    @property
    def values(self) -> list[float]:
        """Current values of all parameters, row by row."""
        return [value for one in self.declared for value in one.values]


class TracedFilter(NamedTuple):
    """A filter as two straight-line programs, ``start`` and ``update``, and the meaning of their rows."""

    start: StraightLineProgram
    """Program from the initial estimate and the parameters to the state."""
    update: StraightLineProgram
    """Program from state and measurement to state and estimate; the input of a network comes first among
    the results.
    """
    initial: list[Member]
    measurement: list[Member]
    state: list[Member]
    """Rows of the argument ``STATE``: the state between two measurements."""
    estimate: list[Member]
    """Rows of the argument ``ESTIMATE``."""
    shown: int
    """Number of results of ``update`` that are the input of a network, the first one whether it is evaluated; zero
    without network.
    """
    network: "LearnedPolicy | None"
    """Network that is evaluated between the two parts of ``update``; None where there is none."""
    free: FreeParameters = FreeParameters()
    """Parameters that its user sets."""


class FilterSteps:
    """A filter's step on traced arrays, without the checks of its estimate that an evaluation makes.

    ``masked`` replaces missing measurements, for a filter that never reads them; ``decider`` evaluates a
    network inside.
    """

    def __init__(
        self,
        filter: Filter[Any, Any, Any],
        masked: Callable[[Any], Any] | None = None,
        decider: Decider | None = None,
        reports_feedback: bool = False,
    ) -> None:
        self.filter = filter
        self.masked = masked
        self.decider = decider
        self.reports_feedback = (
            reports_feedback and bool(array_meanings(filter.task).feedback) and filter.task.closes_loop
        )

    def update(self, state: Any, measurement: Any) -> tuple[Any, dict[str, Any]]:
        """Return the filter's state after a measurement, and numbers by name, such as mean and covariance."""
        own, received = self.filter, measurement if self.masked is None else self.masked(measurement)
        after = own.step(state, FilterInput(received))
        records = own.records(after, received)
        known = {name: records[name] for name in LIKELIHOODS if records.get(name) is not None}
        feedback = own.feedback(after, received) if self.reports_feedback else None
        if feedback is not None:
            known[FEEDBACK] = feedback
        return after, {"mean": own.mean(after), "covariance": own.covariance(after), **known}

    def due_nodes(self, state: Any, graph: Graph) -> list[int]:
        """Return the graph's node that is true where the network is evaluated at this measurement."""
        assert self.decider is not None
        if self.decider.interval == 1:
            return [graph.constant(True)]
        return nodes_of(self.decider.is_due(getattr(state, "agent", state).policy))


def clear_missing(task: Task, measurement: Any) -> Any:
    """Return a traced measurement with zero in place of every missing value."""

    def clear(own: Any, masked: Any) -> Any:
        if own is masked or (own.nodes == masked.nodes).all():
            return own
        return namespace.where(namespace.isnan(masked), 0.0, masked)

    masked = iter(leaves(task.world.mask_missing(measurement)))
    return map_arrays(lambda own: clear(own, next(masked)), measurement)


def action_size(network: "LearnedPolicy") -> int:
    """Return the number of values in a network's action."""
    return 1 if network.output == "argmax" else len(network.layers[-1][1])


class NetworkPlaceholder(Policy):
    """Policy that stands for a network in a trace: stores the network's input, returns new graph inputs."""

    def __init__(self, network: "LearnedPolicy", graph: Graph) -> None:
        super().__init__(network.model)
        self.network = network
        self.graph = graph
        self.control: str = network.control  # type: ignore[misc]
        self.shown: list[int] = []

    def act(self, observation: Any, state: Any, start: Any) -> tuple[Any, Any]:
        """Store the traced observation, and return new inputs of the graph as action; zeros if it is not traced."""
        if not isinstance(observation, Traced):
            return numpy.zeros(
                (1,) if self.network.output == "argmax" else (1, action_size(self.network))
            ), ()
        self.shown = observation[:, self.network.columns].nodes.ravel().tolist()
        nodes = [self.graph.input(ANSWER, i) for i in range(action_size(self.network))]
        if self.network.output == "argmax":
            return Traced(nodes, numpy.int64), ()
        return Traced(numpy.array(nodes)[None], numpy.float64), ()


def check_kind(name: str, maker: Any) -> None:
    """Raise ValueError for a competitor that is neither estimator nor policy."""
    kind = kind_of(maker)
    if kind not in RANKED:
        raise ValueError(
            f"{name!r} is of kind {kind}: only estimators and policies can be exported, which use past and present "
            "measurements alone"
        )


def steps_of(
    traced: Task, control: str, maker: Any, plain: Model, graph: Graph
) -> tuple[FilterSteps, "NetworkPlaceholder | None"]:
    """Return a competitor's step on traced arrays, and the placeholder of its network or None."""
    if _traced_as(maker) == "learned estimator":
        policy, network = replace_network(maker(plain.task).network, graph)
        steered = steer(Model(traced, maker.bank), policy, 1)
        return FilterSteps(steered, functools.partial(clear_missing, traced), steered.decider), network
    if _traced_as(maker) == "gated":
        inside: list[NetworkPlaceholder | None] = []

        def replace(policy: Any) -> Any:
            replaced, network = replace_network(policy, graph)
            inside.append(network)
            return replaced

        gated = maker(traced, replace)
        return FilterSteps(gated, traced.world.mask_missing, gated.decider), inside[0]
    if kind_of(maker) == "estimator":
        own = as_filter(traced, make_competitor(maker, traced))
        if own.in_python:
            raise NotTraceable("its class does not set traceable = True")
        return FilterSteps(own, traced.world.mask_missing), None
    acting = plain if traced.parameters is plain.task.parameters else Model(traced, control)
    policy, network = replace_network(make_competitor(maker, acting), graph)
    if isinstance(policy, RandomPolicy):
        raise NotTraceable("its actions are drawn")
    if not isinstance(policy, Policy):
        raise NotTraceable(
            f"{type(policy).__name__} runs in another library; `filtergym export RUN` writes an agent of a training "
            "run as arrays"
        )
    steered = steer(Model(traced, control), policy)
    # Where a field's name marks received values, the program around the filter fills in a number.
    masked = None if traced.world.received_field else functools.partial(clear_missing, traced)
    return FilterSteps(steered, masked, steered.decider, reports_feedback=True), network


def replace_network(policy: Any, graph: Graph) -> tuple[Any, NetworkPlaceholder | None]:
    """Return a policy whose network a placeholder replaces, and the placeholder; None without a network."""
    if _traced_as(policy) == "network":
        asked = NetworkPlaceholder(policy, graph)
        return asked, asked
    place = getattr(policy, "inner", None)
    if place is None:
        return policy, None
    inner, asked_inside = replace_network(getattr(policy, place), graph)
    policy = copy.copy(policy)
    setattr(policy, place, inner)
    return policy, asked_inside


def _traced_as(found: Any) -> str:
    return getattr(found, "traced_as", "")


# --- structures of arrays


def members_of(part: Any, prefix: str = "", words: str = "") -> list[Member]:
    """Return a :class:`Member` for every number in nested tuples of arrays of one lane."""
    if part is None:
        return []
    if isinstance(part, dict | tuple):
        described: dict[str, str] = {}
        if isinstance(part, dict):
            pairs = list(part.items())
        elif hasattr(part, "_fields"):
            named: Any = part
            pairs, described = list(named._asdict().items()), field_words(type(part))
        else:
            pairs = [(str(i), item) for i, item in enumerate(part)]
        return [
            member
            for name, item in pairs
            for member in members_of(item, f"{prefix}_{name}" if prefix else name, described.get(name, words))
        ]
    shape = tuple(size for size in numpy.shape(getattr(part, "nodes", part)) if size != 1)
    return [Member(prefix or "value", shape, i, words) for i in range(math.prod(shape))]


def nodes_of(part: Any) -> list[int]:
    """Return the graph's nodes of all numbers in nested tuples of traced arrays, in one list."""
    return [node for array in leaves(part) for node in namespace.asarray(array).nodes.ravel().tolist()]


def fill(part: Any, nodes: Sequence[int], graph: Graph) -> Any:
    """Return nested tuples of traced arrays, of the form of ``part``, made of the given nodes."""
    at = iter(nodes)

    def leaf(array: Any) -> Traced:
        array = namespace.asarray(array)
        own = [next(at) for _ in range(array.size)]
        if array.dtype.kind == "b":
            zero = graph.constant(0.0)
            own = [node if graph.logical[node] else graph.node("not_equal", node, zero) for node in own]
        shaped = numpy.array(own, dtype=numpy.int64).reshape(array.shape)
        return Traced(shaped, array.dtype if array.dtype.kind in "ib" else numpy.float64)

    return map_arrays(leaf, part)


def one_lane(part: Any) -> Any:
    """Return nested tuples of arrays ``(..., N)`` cut to the first lane, ``(..., 1)``."""
    return map_arrays(lambda array: array[..., :1], part)


# --- tracing


class _Classes:
    """Classes of state members that are always equal or constant, found by repeated traces of the update.

    Members that start equal form a class, which is constant if they start constant. Where the update makes them differ,
    the class is split, and the update is traced again. Classes that still split after some rounds are given up.
    """

    ROUNDS = 4

    def __init__(self, graph: Graph, first: Sequence[int]) -> None:
        self.graph = graph
        self.rounds = 0
        groups: dict[int, int] = {}
        self.members = [groups.setdefault(node, i) for i, node in enumerate(first)]
        values = {c: graph.values[first[c]] for c in set(self.members)}
        self.fixed = {c: value for c, value in values.items() if value is not None}

    def nodes(self) -> list[int]:
        """Return the graph's nodes of the state before an update: a constant, or one input for each class."""
        return [
            self.graph.constant(self.fixed[c]) if c in self.fixed else self.graph.input(STATE, c)
            for c in self.members
        ]

    def split(self, after: Sequence[int]) -> bool:
        """Split the classes whose members differ after an update; return whether any was split."""
        pairs = list(zip(self.members, after, strict=True))
        groups: dict[tuple[int, int], int] = {}
        members = [groups.setdefault(pair, i) for i, pair in enumerate(pairs)]
        fixed = {
            c: value
            for c, value in self.fixed.items()
            if all(_is_constant(self.graph, node, value) for own, node in pairs if own == c)
        }
        if members == self.members and fixed == self.fixed:
            return False
        self.rounds += 1
        if self.rounds > self.ROUNDS:
            apart = {old for old, new in zip(self.members, members, strict=True) if old != new}
            members = [i if self.members[i] in apart else new for i, new in enumerate(members)]
            fixed = {c: value for c, value in fixed.items() if c not in apart}
        self.fixed = {new: fixed[c] for new, c in zip(members, self.members, strict=True) if c in fixed}
        self.members = members
        return True


def _is_constant(graph: Graph, node: int, value: Any) -> bool:
    known = graph.values[node]
    return known is not None and (known == value or (known != known and value != value))


def trace_filter(
    task: type[Task],
    control: str,
    maker: Any,
    name: str,
    plain: Model,
    template: tuple[Any, Any],
    tunables: Mapping[str, Tunable] = MappingProxyType({}),
) -> TracedFilter:
    """Return a competitor as two straight-line programs, with as many free parameters as possible.

    ``template`` is an initial estimate and a measurement, any numbers of any width.

    Raises:
        ValueError: for a competitor that is neither estimator nor policy, or no straight line of arithmetic.
    """
    check_kind(name, maker)
    found = declaration(plain.task, maker, tunables, name)
    arguments = task, control, maker, plain, template, found
    try:
        fixed = _trace_free(*arguments, [])
    except NotTraceable as error:
        raise ValueError(
            f"{name!r} cannot be exported: it is no straight line of array arithmetic ({error})"
        ) from error
    assert isinstance(fixed, tuple)
    traced, free = fixed, list[Declared]()
    for tried in (found.all, found.tuned, found.own):
        free = tried
        try:
            while isinstance(answer := _trace_free(*arguments, free, fixed[1]), set):
                free = [one for one in free if one.name not in answer]
        except NotTraceable:
            free = []
            continue
        traced = answer
        break
    kept = {one.name for one in free} - {one.name for one in found.tuned}
    left = kept | {one.name for one in traced[0].free.declared}
    constant = [one.name for one in found.all if one.name not in left]
    return traced[0]._replace(free=traced[0].free._replace(constant=constant))


def _trace_free(
    task: type[Task],
    control: str,
    maker: Any,
    plain: Model,
    template: tuple[Any, Any],
    found: Declaration,
    free: Sequence[Declared],
    fixed: "_Nodes | None" = None,
) -> "tuple[TracedFilter, _Nodes] | set[str]":
    """Trace a competitor with some parameters free, or return the names of those that cannot be free.

    ``template`` is an initial estimate and a measurement of any width, ``fixed`` the filter traced without
    free parameters.
    """
    graph = ParameterGraph(free)
    firsts = [0, *itertools.accumulate(len(one.values) for one in free)]
    with namespace.tracing(graph), traced_functions(graph):
        values = {one.name: expressions(one, first, graph) for one, first in zip(free, firsts, strict=False)}
        made = task(plain.task.parameters, namespace)
        own = {one.name: values[one.name] for one in found.own if one.name in values}
        if found.tunable is not None and any(one.name in values for one in found.tuned):
            given = {one.name: values.get(one.name, one.values[0]) for one in found.tuned}
            keywords, make = found.tunable.apply(given)
            maker = TunedPolicy(keywords, found.tunable.control, make, "")
            own |= {name: freeze(value) for name, value in keywords.items()}
        if own:
            made.parameters = with_parameters(made.parameters, own)
            made.set_up()
        traced = _trace(*steps_of(made, control, maker, plain, graph), template, graph, free, fixed)
    names = [one.name for one in free for _ in one.values]
    conditional = graph.rows(list(graph.conditions))
    unused = {names[row] for row in conditional} - {one.name for one in traced[0].free.declared}
    return {names[row] for row in graph.settled} | unused or traced


def _trace(
    steps: FilterSteps,
    asked: "NetworkPlaceholder | None",
    template: tuple[Any, Any],
    graph: ParameterGraph,
    free: Sequence[Declared],
    plain: "_Nodes | None",
) -> tuple[TracedFilter, "_Nodes"]:
    initial, measurement = (one_lane(part) for part in template)
    rows = count_from()
    begin = fill(initial, [graph.input(INITIAL, next(rows)) for _ in nodes_of(initial)], graph)
    rows = count_from()
    z = fill(measurement, [graph.input(MEASUREMENT, next(rows)) for _ in nodes_of(measurement)], graph)
    state = steps.filter.start(begin)
    first = nodes_of(state)
    classes = _Classes(graph, first)
    while True:
        before = fill(state, classes.nodes(), graph)
        following, estimate = steps.update(before, z)
        after = nodes_of(following)
        if len(after) != len(first):
            raise NotTraceable("the arrays of its state change their shapes from measurement to measurement")
        if not classes.split(after):
            break
    shown = []
    if asked is not None and asked.shown and steps.decider is not None:
        shown = [*steps.due_nodes(before, graph), *asked.shown]
    results = nodes_of(estimate)
    live = _live_members(graph, classes.members, after, [*results, *shown])
    place = {member: row for row, member in enumerate(live)}
    written = [
        *(ProgramResult(SHOWN, row, node) for row, node in enumerate(shown)),
        *(ProgramResult(STATE, place[member], after[member]) for member in live),
        *(ProgramResult(ESTIMATE, row, node) for row, node in enumerate(results)),
    ]
    begun = [first[member] for member in live]
    nodes = _Nodes(graph, [*first, *after, *shown, *results])
    own = _Derived(nodes, [result.node for result in written], begun, plain)
    declared, moved = _used_parameters(free, graph.rows(own.nodes))
    conditions = [
        node if held else graph.node("logical_not", node)
        for node, held in graph.conditions.items()
        if declared and graph.rows([node]) <= moved.keys()
    ]
    condition = None
    if conditions:
        whole = functools.reduce(functools.partial(graph.node, "logical_and"), conditions)
        condition = _renumber_rows(program(graph, [ProgramResult(CONDITION, 0, whole)]), PARAMETER, moved)
    derive = _renumber_rows(own.program(), PARAMETER, moved) if declared else None
    own.read()
    start = program(graph, [ProgramResult(STATE, row, node) for row, node in enumerate(begun)])
    update = program(graph, written)
    place |= {KEPT + row: len(live) + row for row in range(own.kept)}
    listed = members_of(state)
    members = [listed[member] for member in live]
    members += [Member("derived", (own.kept,), row, DERIVED_WORDS) for row in range(own.kept)]
    found = TracedFilter(
        _renumber_rows(start, STATE, place),
        _renumber_rows(update, STATE, place),
        members_of(initial),
        members_of(measurement),
        members,
        members_of(estimate),
        len(shown),
        asked.network if shown and asked is not None else None,
        FreeParameters(declared, derive, own.values, own.kept, own.stated, condition),
    )
    return found, nodes


KEPT = 10**9
"""First row in the state of numbers derived from parameters, while a filter is traced."""
DERIVED_WORDS = "Derived from the parameters at the start, constant from then on."
CLOSE = 1e-9
"""Largest relative difference of a derived number to the Python filter's, which computes it in another order."""

SMALL = 1e-15
"""Largest absolute difference of a derived number that may be zero."""


class _Nodes(NamedTuple):
    """A traced filter: its graph, and the nodes of its results."""

    graph: ParameterGraph
    wanted: list[int]
    """Expressions in an order that does not depend on the parameters."""


def _constants_in_place(plain: _Nodes, free: _Nodes) -> dict[int, float]:
    """Compare traces without and with free parameters; return constants of the first by node of the second."""
    one, other, found = plain.graph, free.graph, dict[int, float]()
    waiting = list(zip(plain.wanted, free.wanted, strict=True))
    seen = set(waiting)
    while waiting:
        p, q = waiting.pop()
        if (constant := one.values[p]) is not None:
            found.setdefault(q, float(constant))
        elif one.operations[p] == "take":  # of a table whose entries are chosen one by one where they vary
            table = one.tables[one.arguments[p][0]]
            while other.operations[q] == "where":
                condition, entry, q = other.parts(q)
                if (place := other.values[other.parts(condition)[-1]]) is not None:
                    found.setdefault(entry, float(table[int(place)]))
            found.setdefault(q, float(table[0]))
        elif one.operations[p] == other.operations[q] and len(one.parts(p)) == len(other.parts(q)):
            pairs = [pair for pair in zip(one.parts(p), other.parts(q), strict=True) if pair not in seen]
            seen.update(pairs)
            waiting += pairs
    return found


class _Derived:
    """Largest expressions of a filter that depend on parameters alone, in the order of the rows of ``DERIVED``.

    Those of ``update`` come first; ``plain`` is the filter traced without parameters.

    Attributes:
        nodes: nodes of the expressions.
        values: their values in the filter itself, with the current parameters.
        kept: number of those that the update reads.
        stated: rows whose bits a library decides, or that are computed in another order.
    """

    def __init__(
        self, nodes: "_Nodes", update: Sequence[int], start: Sequence[int], plain: "_Nodes | None"
    ) -> None:
        self.graph = graph = nodes.graph
        both = self._find(update), self._find(start)
        parts = [both[0], [node for node in both[1] if node not in both[0]]]
        values, known = {}, {} if plain is None else _constants_in_place(plain, nodes)
        stated = {node for part in parts for node in part if not graph.is_exact(node)}
        for node in itertools.chain(*parts):
            own = float(graph.value(node))
            there = known.get(node, own)
            values[node] = there if abs(there - own) <= max(CLOSE * abs(own), SMALL) else own
            stated |= {node} if values[node] != own else set()
        # Those whose values are stated stand together.
        parts = [
            sorted(part, key=lambda node: (node in stated) != last)
            for part, last in zip(parts, (False, True), strict=True)
        ]
        self.nodes = [*parts[0], *parts[1]]
        self.values, self.kept = [values[node] for node in self.nodes], len(parts[0])
        first = sum(node not in stated for node in parts[0])
        self.stated = range(first, first + len(stated))

    def _find(self, wanted: Sequence[int]) -> list[int]:
        graph, found = self.graph, dict[int, None]()
        kinds: dict[int, int] = {}  # 0 constant, 1 of parameters alone, 2 of anything else
        for node in graph.live(wanted):
            parts = graph.parts(node)
            if graph.operations[node] == "input":
                kinds[node] = 1 if graph.arguments[node][0] == PARAMETER else 2
            else:
                constant = graph.values[node] is not None
                kinds[node] = 0 if constant else max((kinds[part] for part in parts), default=0)
            if kinds[node] == 2:
                found |= dict.fromkeys(part for part in parts if kinds[part] == 1)
        return list(found | dict.fromkeys(node for node in wanted if kinds[node] == 1))

    def program(self) -> StraightLineProgram:
        """Return the straight-line program from the parameters to the values of ``nodes``."""
        graph = self.graph
        numbers = [graph.node("number", node) if graph.logical[node] else node for node in self.nodes]
        return program(graph, [ProgramResult(DERIVED, row, node) for row, node in enumerate(numbers)])

    def read(self) -> None:
        """Replace these expressions in the graph by inputs from the state or from ``DERIVED``."""
        graph = self.graph
        for row, node in enumerate(self.nodes):
            given = (STATE, KEPT + row) if row < self.kept else (DERIVED, row)
            if graph.logical[node]:
                again = graph.input(*given), graph.constant(0.0)
                graph.operations[node], graph.arguments[node] = "not_equal", again
            else:
                graph.operations[node], graph.arguments[node] = "input", given


def _used_parameters(free: Sequence[Declared], used: set[int]) -> tuple[list[Declared], dict[int, int]]:
    """Return the parameters of which a row is used, and the new number of each of their rows by the old one."""
    declared, first = list[Declared](), 0
    moved: dict[int, int] = {}
    for one in free:
        rows = range(first, first + len(one.values))
        first = rows.stop
        if used.intersection(rows):
            moved |= {row: len(moved) + i for i, row in enumerate(rows)}
            declared.append(one)
    return declared, moved


def _live_members(
    graph: Graph, classes: Sequence[int], after: Sequence[int], wanted: Sequence[int]
) -> list[int]:

    def read(nodes: Sequence[int]) -> set[int]:
        inputs = (node for node in graph.live(nodes) if graph.operations[node] == "input")
        return {graph.arguments[node][1] for node in inputs if graph.arguments[node][0] == STATE}

    live = read(wanted)
    while True:
        more = live | read([after[member] for member in live])
        if more == live:
            return sorted(live)
        live = more


def _renumber_rows(code: StraightLineProgram, argument: int, place: Mapping[int, int]) -> StraightLineProgram:
    """Return a program in which the rows of one argument are renumbered by ``place``."""
    steps, arguments = code.steps, code.steps.arguments.copy()
    inputs = steps.begins[:-1][steps.which("input")]
    rows = 1 + inputs[arguments[inputs] == argument]
    arguments[rows] = [place[row] for row in arguments[rows].tolist()]
    renumbered = ProgramSteps(steps.names, steps.kinds, steps.begins, arguments, steps.logical)
    return code._replace(steps=renumbered)
