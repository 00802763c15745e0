"""One function that calls the function of a kind, written from declarations: a compiler wants plain code."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from factorbus.solver.kernels.model import layout as at

_ARGUMENTS = "x, ends, p, k, r, A, B"
_OF_ONE_KIND = "x, ends.i, ends.j, p, k, r, A, B"


class Model(Protocol):
    """Of a `kinds.FactorModel` what is looked at."""

    @property
    def residual(self) -> Callable[..., Any]: ...
    @property
    def of_kinds(self) -> bool: ...
    @property
    def lens_at(self) -> int: ...


def dispatcher(name: str, models: Mapping[str, Model], others: Callable[..., Any] | None = None) -> Callable[..., Any]:
    """A function `name`(kind, x, ends, p, k, r, A, B) that calls the residual function of the kind, one of `models`, or
    `others` with the same arguments; it returns what χ² has beside rᵀ Ω r.  ends: `records.Ends`.

    Kinds of one function are tested together, where the first of them is.
    """
    codes: dict[Callable[..., Any], list[int]] = {}
    of: dict[Callable[..., Any], Model] = {}
    for kind, model in models.items():
        codes.setdefault(model.residual, []).append(at.FACTOR_CODES[kind])
        of[model.residual] = model
    names: dict[str, Any] = {"__name__": __name__}
    lines = [f"def {name}(kind, {_ARGUMENTS}):", "    more = 0.0"]
    word = "if"
    for n, (function, kinds) in enumerate(codes.items()):
        names[f"residual_{n}"] = function
        call = f"residual_{n}({f'kind, {_ARGUMENTS}' if of[function].of_kinds else _OF_ONE_KIND})"
        lines += [
            f"    {word} {' or '.join(f'kind == {code}' for code in kinds)}:",
            f"        {'more = ' if of[function].lens_at >= 0 else ''}{call}",
        ]
        word = "elif"
    if others is not None:
        names["others"] = others
        lines += ["    else:", f"        more = others(kind, {_ARGUMENTS})"]
    lines.append("    return more")
    return _made(name, lines, names)


def returning(
    name: str,
    arguments: str,
    codes: Mapping[str, int],
    functions: Mapping[str, Callable[..., Any]],
    otherwise: Callable[..., Any],
) -> Callable[..., Any]:
    """A function `name`(kind, arguments) that returns what the function of the kind does, or `otherwise`."""
    names: dict[str, Any] = {"__name__": __name__, "otherwise": otherwise}
    lines = [f"def {name}(kind, {arguments}):"]
    for n, (kind, function) in enumerate(functions.items()):
        names[f"function_{n}"] = function
        lines += [f"    if kind == {codes[kind]}:", f"        return function_{n}({arguments})"]
    lines.append(f"    return otherwise({arguments})")
    return _made(name, lines, names)


def check_same(what: str, wire: Mapping[str, Any], models: Mapping[str, Any], where: str) -> None:
    """Every name of the wire's table is in that of the module `where`, and no other.  Raises ImportError."""
    for name in sorted(wire.keys() ^ models.keys()):
        there, missing = ("factorbus.proto.kinds", where) if name in wire else (where, "factorbus.proto.kinds")
        raise ImportError(f"the {what} {name!r} is declared in {there} but not in {missing}; declare it in both")


def _made(name: str, lines: list[str], names: dict[str, Any]) -> Callable[..., Any]:
    """The function with this source, which uses these names."""
    source = "\n".join(lines)
    exec(compile(source, f"<{name}, written by {__name__}>", "exec"), names)
    return names[name]
