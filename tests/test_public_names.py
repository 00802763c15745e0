"""A public name stands for one thing: no function or class is defined under it in two modules.

Not counted: twins that are alike on purpose (asyncio's client, a kernel for each kind of processor, one thing in two
layers), the subcommands of the command line, whose names are those that a user types, and what starts a process.
"""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TWINS = (
    {"client/aio", "client/bus"},
    {"client/aio", "client/map"},
    {"client/aio", "client/features"},
    {"client/aio_uncertainty", "client/uncertainty"},
    {"solver/kernels/jit/simd_checked", "solver/kernels/jit/simd_llvm", "solver/kernels/jit/simd_plain"},
    {
        "solver/covariance/kernels/tiles_checked",
        "solver/covariance/kernels/tiles_llvm",
        "solver/covariance/kernels/tiles_plain",
    },
    {"proto/problems", "solver/errors"},  # an error of the solver travels as the problem of that name and code
    {"proto/factor_kind", "solver/graph/factors"},  # a kind as the wire has it, and with its code in kernels
    {"proto/variable_kinds", "solver/graph/variables"},
    {"client/expressions", "solver/formulas/groups"},  # an operation as it is written and as it is done
    {"client/expressions", "solver/formulas/vectors"},
    {"client/expressions", "solver/kernels/model/se2"},
    {"service/config", "workers/config"},  # BadConfig, of two programs
    {"idp/classical", "idp/independent", "idp/minimal"},  # three ways to the same covariance
)
STARTS = {"main"}


def test_no_public_name_is_defined_twice() -> None:
    found = {name for name, modules in defined().items() if len(modules) > 1 and not any(modules <= t for t in TWINS)}
    assert sorted(found) == [], "give one of each a name of its own"


def defined() -> dict[str, set[str]]:
    """Modules by the public name of a function or class that each defines, at its outermost level."""
    modules = defaultdict[str, set[str]](set)
    for root in ("proto", "service", "workers", "clients"):
        for path in sorted((ROOT / root / "factorbus").rglob("*.py")):
            module = path.relative_to(ROOT / root / "factorbus").with_suffix("").as_posix()
            for name in names(ast.parse(path.read_text(encoding="utf-8"))):
                modules[name].add(module)
    return modules


def names(module: ast.Module) -> Iterator[str]:
    for node in module.body:
        defines = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        if defines and not node.name.startswith("_") and node.name not in STARTS and not is_subcommand(node):
            yield node.name


def is_subcommand(node: ast.AST) -> bool:
    decorators = [ast.unparse(each) for each in getattr(node, "decorator_list", ())]
    return any(each.partition("(")[0].endswith((".command", ".group")) for each in decorators)
