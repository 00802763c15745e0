"""A factor kind of one's own as text, which is its name on the wire: all that is to be known of it.

    range_with_bias(a:se3,l:point3,bias:vector1,z:1)=subtract(add(norm(act(inverse(a),l)),bias),z)

Before "=" are the variables with their kinds, and z, what is measured, with its type; behind it the residual, made of
`operations`, of numbers, and of lists of them.  What is used more than once stands before it with a name:

    ...=_1=act(inverse(a),l);vector(atan2(part(_1,1,1),part(_1,0,1)),norm(_1))
"""

import re
from dataclasses import dataclass, field
from functools import lru_cache

from factorbus.proto.expressions.declaration import (
    CONSTANT,
    MEASURED,
    MOST_NODES,
    BadExpression,
    Declaration,
    ExpressionNode,
    declare,
)
from factorbus.proto.expressions.operations import OPERATIONS, Type
from factorbus.proto.nearest import nearest

MOST_CHARACTERS = 16384
_TOKEN = re.compile(r"\s*(?:([a-z_][a-z0-9_]*)|([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)|([():,=;\[\]]))", re.ASCII)
_LETTERS = "small letters, digits, _ and ( ) [ ] , : ; = - + . of ASCII alone"
_FORM = "name(a:KIND,b:KIND,z:TYPE)=residual"


@lru_cache(maxsize=256)
def write_formula(declared: Declaration) -> str:
    """The text of a kind.  Two kinds that are the same have the same."""
    parameters = declared.parameters
    texts, used, steps = [*parameters], [0] * len(declared.types), list[str]()
    for node in declared.nodes:
        for k in node.of:
            used[k] += 1
    for node in declared.nodes:
        if node.operation == CONSTANT:
            numbers = [_number(number) for number in node.numbers]
            texts.append(numbers[0] if len(numbers) == 1 else f"[{','.join(numbers)}]")
            continue
        text = f"{node.operation}({','.join([*(texts[i] for i in node.of), *map(_number, node.numbers)])})"
        if used[len(texts)] > 1:
            name = f"_{len(steps) + 1}"
            steps.append(f"{name}={text};")
            text = name
        texts.append(text)
    ends = [f"{called}:{kind}" for called, kind in declared.variables]
    return f"{declared.name}({','.join([*ends, f'{MEASURED}:{declared.measured}'])})={''.join(steps)}{texts[-1]}"


def _number(number: float) -> str:
    return f"{number:.0f}" if number == int(number) and abs(number) < 1e15 else repr(number)


@lru_cache(maxsize=256)
def read_formula(text: str) -> Declaration:
    """The kind that a text declares.  Raises BadExpression: none, and why."""
    if len(text) > MOST_CHARACTERS:
        raise BadExpression(f"a formula has {len(text)} characters; wanted at most {MOST_CHARACTERS}")
    reader = _Reader(text)
    name, variables, measured = reader.head()
    nodes, last = reader.body([*(called for called, _ in variables), MEASURED])
    return declare(name, variables, measured, nodes, last)


@dataclass
class _Call:
    """An operation whose arguments are being read."""

    operation: str
    of: list[int] = field(default_factory=list)
    numbers: list[float] = field(default_factory=list)


class _Reader:
    """Reads from the left, and goes back nowhere."""

    def __init__(self, text: str) -> None:
        self._text, self._here, self._first = text, 0, 0
        self._nodes: dict[ExpressionNode, int] = {}

    def head(self) -> tuple[str, tuple[tuple[str, str], ...], Type]:
        """The name, the variables and z, up to the "="."""
        name, variables, measured = self._word(), list[tuple[str, str]](), None
        self._take("(")
        while True:
            called = self._word()
            self._take(":")
            kind = self._next()
            if called == MEASURED:
                measured = int(kind) if kind.isdigit() and len(kind) < 4 else kind
            else:
                variables.append((called, kind))
            if (mark := self._next()) == ")":
                break
            if mark != "," or measured is not None:
                raise self._wrong(f'"," or ")", and {MEASURED} as the last')
        self._take("=")
        if measured is None:
            raise BadExpression(f"{name[:80]}: nothing is measured; wanted {MEASURED}:TYPE as the last, {_FORM}")
        return name, tuple(variables), measured

    def body(self, parameters: list[str]) -> tuple[list[ExpressionNode], int]:
        """The nodes, and which is the residual."""
        known = {called: k for k, called in enumerate(parameters)}
        self._first = len(parameters)
        while True:
            start = self._here
            word = self._peek()
            named = ""
            if word.startswith("_"):
                self._next()
                if self._peek() == "=":
                    self._next()
                    named = word
                else:
                    self._here = start
            last = self._expression(known)
            if not named:
                break
            if named in known:
                raise self._wrong(f"a name that is not used yet in place of {named}")
            known[named] = last
            self._take(";")
        if self._text[self._here :].strip():
            raise self._wrong("the end")
        return [*self._nodes], last

    def _expression(self, known: dict[str, int]) -> int:
        """The node of one expression, which may be nested to any depth."""
        calls = list[_Call]()
        while True:
            token = self._next()
            if token in OPERATIONS and not (token in known and self._peek() != "("):  # a variable may be called so
                self._take("(")
                calls.append(_Call(token))
                continue
            if token == "[":
                found = self._add(ExpressionNode(CONSTANT, (), self._list()))
            elif token in known:
                found = known[token]
            elif (number := _float(token)) is not None:
                call = calls[-1] if calls else None
                if call and OPERATIONS[call.operation].numbers and len(call.of) == OPERATIONS[call.operation].arguments:
                    call.numbers.append(number)
                    found = -1
                else:
                    found = self._add(ExpressionNode(CONSTANT, (), (number,)))
            else:
                there = f"a variable, a number, or one of {', '.join(OPERATIONS)}"
                raise self._wrong(there + nearest(token, [*known, *OPERATIONS]), token)
            while calls:
                if found >= 0:
                    calls[-1].of.append(found)
                mark = self._next()
                if mark == ",":
                    break
                if mark != ")":
                    raise self._wrong('"," or ")"', mark)
                call = calls.pop()
                found = self._add(ExpressionNode(call.operation, tuple(call.of), tuple(call.numbers)))
            else:
                return found

    def _list(self) -> tuple[float, ...]:
        numbers = list[float]()
        while True:
            token = self._next()
            if (number := _float(token)) is None:
                raise self._wrong("a number", token)
            numbers.append(number)
            if (mark := self._next()) == "]":
                return tuple(numbers)
            if mark != ",":
                raise self._wrong('"," or "]"', mark)

    def _add(self, node: ExpressionNode) -> int:
        """The same operation on the same nodes is one node."""
        if node not in self._nodes:
            if len(self._nodes) == MOST_NODES:
                raise BadExpression(f"a formula has more than {MOST_NODES} nodes; wanted at most that")
            self._nodes[node] = self._first + len(self._nodes)
        return self._nodes[node]

    def _peek(self) -> str:
        found = _TOKEN.match(self._text, self._here)
        return (found[1] or found[2] or found[3]) if found else ""

    def _next(self) -> str:
        found = _TOKEN.match(self._text, self._here)
        if found is None:
            raise self._wrong(_LETTERS if self._text[self._here :].strip() else "more of a formula")
        self._here = found.end()
        return found[1] or found[2] or found[3]

    def _word(self) -> str:
        word = self._next()
        if not word[0].isalpha():
            raise self._wrong("a name, which begins with a small letter", word)
        return word

    def _take(self, mark: str) -> None:
        if (token := self._next()) != mark:
            raise self._wrong(f'"{mark}"', token)

    def _wrong(self, wanted: str, seen: str = "") -> BadExpression:
        end = max(0, self._here - len(seen))
        before, after = self._text[max(0, end - 40) : end], self._text[end : end + 20]
        here = f"{'…' if end > 40 else ''}{before} ⟨here⟩ {after}{'…' if end + 20 < len(self._text) else ''}"
        return BadExpression(f"a formula is {here}; wanted {wanted}; the form is {_FORM}")


def _float(token: str) -> float | None:
    try:
        return float(token) if not token[0].isalpha() else None
    except ValueError:
        return None
