"""Random own kinds: expressions of any operations, of variables of one space."""

import numpy as np

from factorbus.proto.expressions.declaration import (
    CONSTANT,
    BadExpression,
    Declaration,
    ExpressionNode,
    declare,
    type_of,
)
from factorbus.proto.expressions.operations import GROUPS, OPERATIONS, Mismatch, Type

KINDS = ("se2", "se3", "point2", "point3", "idp", "vector1", "vector3", "vector4")
_NUMBERS = ((0.5,), (2.0, -1.0), (1.0, 0.25, -3.0))


def random_formula(rng: np.random.Generator, nodes: int = 12) -> Declaration:
    """A kind that is one: all of what its nodes give is in its residual, as far as that is a vector."""
    while True:
        kinds = [str(kind) for kind in rng.choice(KINDS, int(rng.integers(1, 5)))]
        measured: Type = [*GROUPS, 1, 2, 3, 6][int(rng.integers(len(GROUPS) + 4))]
        variables = tuple((f"x{n}", kind) for n, kind in enumerate(kinds))
        types, made = [*map(type_of, kinds), measured], list[ExpressionNode]()
        first = len(types)
        while len(made) < nodes:
            node, gives = _random_node(types, rng)
            made.append(node)
            types.append(gives)
        ends = [first + k for k, kind in enumerate(types[first:]) if isinstance(kind, int)]
        made.append(ExpressionNode("vector", tuple(int(k) for k in rng.permutation(ends)[:5])))
        try:
            return declare("random", variables, measured, made, len(types))
        except BadExpression:  # too long a residual, or a variable has no part in it
            continue


def _random_node(types: list[Type], rng: np.random.Generator) -> tuple[ExpressionNode, Type]:
    while True:
        name = str(rng.choice([*OPERATIONS, CONSTANT]))
        if name == CONSTANT:
            numbers = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
            return ExpressionNode(CONSTANT, (), numbers), len(numbers)
        operation = OPERATIONS[name]
        count = operation.arguments if operation.arguments >= 0 else int(rng.integers(1, 4))
        of = tuple(int(k) for k in rng.integers(len(types), size=count))
        numbers = tuple(float(n) for n in rng.integers(0, 3, operation.numbers))
        try:
            return ExpressionNode(name, of, numbers), operation.gives([types[k] for k in of], [int(n) for n in numbers])
        except Mismatch:
            continue
