"""A factor kind of one's own: its variables, what is measured, and its residual as an expression of them.

The expression is a list of nodes.  The first are the variables and what is measured, in this order; each further one is
an operation on nodes before it, by their numbers, or a constant.  The last is the residual.  `formula` writes and reads
it as text.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from factorbus.proto.expressions.operations import (
    GROUPS,
    OPERATIONS,
    Mismatch,
    Type,
    name_of,
    tangent_size,
    value_size,
)
from factorbus.proto.nearest import nearest
from factorbus.proto.problems import Problem
from factorbus.proto.variable_kinds import VARIABLE_KINDS
from factorbus.wording import counted

CONSTANT = "constant"
MOST_VARIABLES, MOST_NODES, MOST_MEASURED, MOST_RESIDUAL, MOST_SCALARS = 16, 500, 64, 64, 128
MOST_RESULTS = 1024  # numbers of the values of all nodes
MEASURED = "z"
NAME = re.compile(r"[a-z][a-z0-9_]{0,62}")
PARAMETER = re.compile(r"[a-z][a-z0-9_]{0,31}")
_NAMES = "up to {} small letters, digits and _, a letter first"


class BadExpression(Problem, ValueError):
    """There is no such factor kind, and why."""

    code = "unknown_kind"


@dataclass(frozen=True)
class ExpressionNode:
    """An operation on the nodes `of`, with its constant integers; or a constant, with its numbers."""

    operation: str
    of: tuple[int, ...] = ()
    numbers: tuple[float, ...] = ()


@dataclass(frozen=True)
class Declaration:
    """One kind.

    variables: what each is called, and its kind.  measured: the type of z (`operations`).
    """

    name: str
    variables: tuple[tuple[str, str], ...]
    measured: Type
    nodes: tuple[ExpressionNode, ...]

    @cached_property
    def types(self) -> tuple[Type, ...]:
        """Of the variables, of z, and of each node.  Raises BadExpression: this is no kind."""
        return _checked(self)

    @property
    def residual_size(self) -> int:
        """How many numbers the residual has."""
        return value_size(self.types[-1])

    @cached_property
    def result_size(self) -> int:
        """How many numbers the values of all nodes have: what it costs to compile goes with it."""
        return sum(map(value_size, self.types[len(self.variables) + 1 :]))

    @property
    def scalars(self) -> int:
        """How many numbers a change of all variables has."""
        return sum(tangent_size(kind) for kind in self.types[: len(self.variables)])

    @property
    def parameters(self) -> tuple[str, ...]:
        """What the first nodes are called: the variables, and z."""
        return (*(called for called, _ in self.variables), MEASURED)


def declare(
    name: str, variables: tuple[tuple[str, str], ...], measured: Type, nodes: Sequence[ExpressionNode], last: int
) -> Declaration:
    """The kind whose residual is the node `last`, of the nodes that it needs, each once, behind those that it needs.

    Raises BadExpression: it is no kind, and why.
    """
    first = len(variables) + 1
    if last < first:
        nodes, last = [*nodes, ExpressionNode("vector", (last,))], first + len(nodes)
    place = {k: k for k in range(first)}
    waiting, kept = [last], dict[ExpressionNode, int]()
    while waiting:
        k = waiting[-1]
        missing = [] if k in place else [i for i in nodes[k - first].of if i not in place]
        if missing:
            waiting += reversed(missing)
            continue
        waiting.pop()
        if k not in place:
            node = nodes[k - first]
            same = ExpressionNode(node.operation, tuple(place[i] for i in node.of), node.numbers)
            place[k] = kept.setdefault(same, first + len(kept))
    made = Declaration(name, variables, measured, tuple(kept))
    made.types  # noqa: B018  (they are checked)
    return made


def type_of(kind: str) -> Type:
    """The type of the value of a variable.  Raises BadExpression: expressions have no such type."""
    if kind in GROUPS:
        return kind
    of = VARIABLE_KINDS.get(kind)
    if of is None or of.size != of.dim:
        has = [name for name, has in VARIABLE_KINDS.items() if name in GROUPS or has.size == has.dim]
        raise BadExpression(
            f"{kind!r} is no kind of variable of an expression; wanted {', '.join(has)}{nearest(kind, has)}"
        )
    return of.size


def _checked(declared: Declaration) -> tuple[Type, ...]:
    _check_head(declared)
    types: list[Type] = [*(type_of(kind) for _, kind in declared.variables), declared.measured]
    scalars, numbers = sum(map(tangent_size, types[:-1])), 0
    for node in declared.nodes:
        types.append(_type_of_node(declared, node, types))
        numbers += value_size(types[-1])
    if not isinstance(types[-1], int) or types[-1] > MOST_RESIDUAL:
        raise BadExpression(
            f"{declared.name}: its residual is {name_of(types[-1])}; wanted 1 to {MOST_RESIDUAL} numbers"
        )
    used = {k for node in declared.nodes for k in node.of}
    if missing := [called for k, called in enumerate(declared.parameters[:-1]) if k not in used]:
        raise BadExpression(
            f"{declared.name}: its residual does not depend on {missing[0]}; wanted it without that one"
        )
    if scalars > MOST_SCALARS or numbers > MOST_RESULTS:
        raise BadExpression(
            f"{declared.name}: its variables have {scalars} scalars and the results of its nodes {numbers} numbers; "
            f"wanted at most {MOST_SCALARS} and {MOST_RESULTS}"
        )
    return tuple(types)


def _check_head(declared: Declaration) -> None:
    name, measured, parameters = declared.name, declared.measured, declared.parameters
    if not NAME.fullmatch(name):
        raise BadExpression(f"a kind cannot be called {name[:80]!r}; wanted {_NAMES.format(63)}")
    if not 1 <= len(declared.variables) <= MOST_VARIABLES:
        raise BadExpression(f"{name}: {counted(len(declared.variables), 'variable')}; wanted 1 to {MOST_VARIABLES}")
    for called in parameters:
        if not PARAMETER.fullmatch(called) or parameters.count(called) > 1:
            raise BadExpression(
                f"{name}: a variable is called {called[:80]!r}; wanted a name of its own of {_NAMES.format(32)}, "
                f"and {MEASURED} for what is measured alone"
            )
    if measured not in GROUPS and not (isinstance(measured, int) and 1 <= measured <= MOST_MEASURED):
        raise BadExpression(
            f"{name}: what is measured is {measured!r}; wanted {', '.join(GROUPS)}, or 1 to {MOST_MEASURED} numbers"
        )
    if not 1 <= len(declared.nodes) <= MOST_NODES:
        raise BadExpression(f"{name}: {counted(len(declared.nodes), 'node')}; wanted 1 to {MOST_NODES}")


def _type_of_node(declared: Declaration, node: ExpressionNode, types: Sequence[Type]) -> Type:
    here = len(types)
    where = f"{declared.name}: {node.operation}, node {here}"
    if node.operation == CONSTANT:
        return _type_of_constant(where, node)
    operation = OPERATIONS.get(node.operation)
    if operation is None:
        raise BadExpression(
            f"{where}: there is no such operation; wanted {', '.join(OPERATIONS)}{nearest(node.operation, OPERATIONS)}"
        )
    if any(not 0 <= k < here for k in node.of) or operation.arguments not in (-1, len(node.of)):
        wanted = "any number" if operation.arguments < 0 else str(operation.arguments)
        raise BadExpression(f"{where}: its arguments are {list(node.of)}; wanted {wanted} of the nodes before it")
    if len(node.numbers) != operation.numbers or any(n != int(n) for n in node.numbers):
        raise BadExpression(f"{where}: its numbers are {list(node.numbers)}; wanted {operation.numbers} integers")
    try:
        return operation.gives([types[k] for k in node.of], [int(n) for n in node.numbers])
    except Mismatch as problem:
        raise BadExpression(f"{where}: {problem}") from None


def _type_of_constant(where: str, node: ExpressionNode) -> Type:
    if node.of or not 1 <= len(node.numbers) <= MOST_MEASURED or not all(map(math.isfinite, node.numbers)):
        raise BadExpression(f"{where}: {list(node.numbers)}; wanted 1 to {MOST_MEASURED} finite numbers")
    return len(node.numbers)
