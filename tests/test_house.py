"""The shape of the house: short files, functions of few parameters, columns of tables by their names."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("proto", "service", "workers", "clients")
MOST_PARAMETERS = 8
MOST_LINES = 400
INTEGERS = {"I8", "I16", "I32", "I64", "U8", "U32", "U64", "Ints", "IntRows"}
COUNTERS = {"counts", "state"}  # one row, whose columns have names
ALLOCATES = {"empty", "zeros", "full"}
# Bits of words in three arrays of words, which are no columns.
NO_TABLES = {("service/factorbus/solver/kernels/bayes_tree/order_small.py", "planes")}


def sources() -> list[Path]:
    return [path for root in SOURCES for path in sorted((ROOT / root / "factorbus").rglob("*.py"))]


def called(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.arg]:
    """Those of a signature, without self or cls."""
    own = function.args
    every = [*own.posonlyargs, *own.args, *own.kwonlyargs]
    return every[1:] if every and every[0].arg in ("self", "cls") else every


def test_every_package_says_that_it_has_types() -> None:
    """A type checker looks at the annotations of an installed package only where there is a `py.typed`."""
    packages = [path for root in SOURCES for path in (ROOT / root / "factorbus").iterdir() if any(path.glob("*.py"))]
    assert len(packages) > 10
    assert not [called(path) for path in packages if not (path / "py.typed").is_file()]


def test_no_function_has_more_than_eight_parameters() -> None:
    found = {
        (called(path), function.name)
        for path in sources()
        for function in functions(path)
        if len(parameters(function)) > MOST_PARAMETERS
    }
    assert sorted(found) == []


def test_no_file_has_more_than_400_lines() -> None:
    tests = sorted((ROOT / "tests").rglob("*.py"))
    found = {called(path) for path in [*sources(), *tests] if len(path.read_bytes().splitlines()) > MOST_LINES}
    assert sorted(found) == []


def test_the_solver_is_a_front_of_few_lines() -> None:
    """What a step does is behind `Stepper`, what changes a map in `changing`."""
    tree = ast.parse((ROOT / "service/factorbus/solver/solver.py").read_text(encoding="utf-8"))
    (solver,) = (node for node in tree.body if isinstance(node, ast.ClassDef))
    assert (solver.end_lineno or 0) - solver.lineno + 1 < 150


def test_no_column_of_a_table_is_called_by_a_number() -> None:
    """An array of integers in a kernel is a table: 0 and 1 may be a pair's ends, from 2 on a column has a name."""
    records = set(record_tables())
    found = {
        (called(path), name)
        for path in sources()
        if "kernels" in path.parts
        for function in functions(path)
        for name in numbered_columns(function, records)
    }
    assert sorted(found - NO_TABLES) == []


def test_no_column_is_called_by_a_number_outside_kernels_and_in_tests() -> None:
    """There a column is `graph.var[…, 3]` or `graph.counts[4]`; one index alone is a row."""
    records = set(record_tables())
    found = {
        (called(path), name)
        for path in [*sources(), *sorted((ROOT / "tests").rglob("*.py"))]
        if "kernels" not in path.parts and path != Path(__file__).resolve()
        for name in columns_from_outside(ast.parse(path.read_text(encoding="utf-8")), records)
    }
    assert sorted(found) == []


def columns_from_outside(module: ast.AST, records: set[str]) -> Iterator[str]:
    """Columns of records' arrays that are read or written at a literal from 2 on."""
    for node in ast.walk(module):
        match node:
            case ast.Subscript(value=ast.Attribute(attr=name), slice=index) if name in records and is_number(index):
                if isinstance(index, ast.Tuple) or name in COUNTERS:
                    yield ast.unparse(node)


def record_tables() -> Iterator[str]:
    """Names of the fields of records that are arrays of integers."""
    for path in sources():
        if "kernels" in path.parts:
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef) and "NamedTuple" in map(ast.unparse, node.bases):
                    for field in node.body:
                        if isinstance(field, ast.AnnAssign) and ast.unparse(field.annotation) in INTEGERS:
                            yield ast.unparse(field.target)


def numbered_columns(function: ast.FunctionDef | ast.AsyncFunctionDef, records: set[str]) -> Iterator[str]:
    """Arrays of integers that the function reads or writes at a literal column from 2 on."""
    tables = {each.arg for each in parameters(function) if each.annotation and ast.unparse(each.annotation) in INTEGERS}
    for node in ast.walk(function):
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Call(func=ast.Attribute(attr=attr))):
                if attr in ALLOCATES and "int64" in ast.unparse(node.value):
                    tables.add(name)
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Attribute(attr=attr)) if attr in records:
                tables.add(name)
    for node in ast.walk(function):
        if isinstance(node, ast.Subscript) and is_number(node.slice):
            match node.value:
                case ast.Name(id=name) if name in tables:
                    yield name
                case ast.Attribute(attr=name) if name in records:
                    yield ast.unparse(node.value)


def is_number(index: ast.expr) -> bool:
    """`[…, 2]` or `[2]`, and above."""
    last = index.elts[-1] if isinstance(index, ast.Tuple) and index.elts else index
    return isinstance(last, ast.Constant) and type(last.value) is int and last.value >= 2


def test_the_walk_sees_what_it_is_to_see() -> None:
    function = ast.parse(
        "def f(self, a: I64, b: F64, *, c: I64) -> None:\n"
        "    rows = tree.rows\n"
        "    a[0, 7] = b[0, 7] + c[1] + clique.rows[k, 3] + rows[2]\n"
    )
    (kernel,) = [node for node in ast.walk(function) if isinstance(node, ast.FunctionDef)]
    assert [each.arg for each in parameters(kernel)] == ["a", "b", "c"]
    assert sorted(numbered_columns(kernel, {"rows"})) == ["a", "clique.rows", "rows"]
    outside = ast.parse("graph.var[v, 3] = graph.counts[4] + graph.keys[5] + graph.fac[:, 1] + matrix.T[2, 2]")
    assert sorted(columns_from_outside(outside, {"var", "counts", "keys", "fac"})) == [
        "graph.counts[4]",
        "graph.var[v, 3]",
    ]
