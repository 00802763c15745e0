"""The shape of the house: short files, functions of few parameters, columns of tables by their names.

The lists have what is still above; one that no longer is leaves its list.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("proto", "service", "workers", "clients")
MOST_PARAMETERS = 8
MOST_LINES = 400
INTEGERS = {"I8", "I16", "I32", "I64", "U8", "U32", "U64", "Ints", "IntRows"}
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


def test_no_function_has_more_than_eight_parameters() -> None:
    found = {
        (called(path), function.name)
        for path in sources()
        for function in functions(path)
        if len(parameters(function)) > MOST_PARAMETERS
    }
    assert_only(found, flat(PARAMETERS_LEFT))


def test_no_file_has_more_than_400_lines() -> None:
    tests = sorted((ROOT / "tests").rglob("*.py"))
    found = {called(path) for path in [*sources(), *tests] if len(path.read_bytes().splitlines()) > MOST_LINES}
    assert_only(found, FILES_LEFT)


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
    assert_only(found - NO_TABLES, flat(COLUMNS_LEFT))


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


def flat(left: dict[str, tuple[str, ...]]) -> set[tuple[str, str]]:
    return {(path, name) for path, names in left.items() for name in names}


def assert_only(found: set, left: set) -> None:
    assert sorted(found - left) == [], "mend these"
    assert sorted(left - found) == [], "these are mended: take them from the list"


def test_the_walk_sees_what_it_is_to_see() -> None:
    function = ast.parse(
        "def f(self, a: I64, b: F64, *, c: I64) -> None:\n"
        "    rows = tree.rows\n"
        "    a[0, 7] = b[0, 7] + c[1] + clique.rows[k, 3] + rows[2]\n"
    )
    (kernel,) = [node for node in ast.walk(function) if isinstance(node, ast.FunctionDef)]
    assert [each.arg for each in parameters(kernel)] == ["a", "b", "c"]
    assert sorted(numbered_columns(kernel, {"rows"})) == ["a", "clique.rows", "rows"]


# Functions above, by file.
PARAMETERS_LEFT = {
    "service/factorbus/service/jobs/features.py": ("__init__",),
    "service/factorbus/service/kernels/write.py": ("write_messages", "write_variables"),
    "service/factorbus/solver/covariance/kernels/columns.py": ("climb", "cross_blocks"),
    "service/factorbus/solver/covariance/kernels/compatible.py": ("search",),
    "service/factorbus/solver/covariance/kernels/judge.py": ("expect", "judge"),
    "service/factorbus/solver/covariance/kernels/loops.py": ("descend", "lessen", "put_factors", "scale", "work_in"),
    "service/factorbus/solver/covariance/kernels/recursion.py": ("diagonal_blocks", "put_diagonal"),
    "service/factorbus/solver/covariance/kernels/squares.py": ("gather",),
    "service/factorbus/solver/covariance/kernels/substitute.py": ("backward", "collect", "distribute", "forward"),
    "service/factorbus/solver/covariance/kernels/tiles_checked.py": (
        "_product_within",
        "copy_runs",
        "negative",
        "subtract",
    ),
    "service/factorbus/solver/covariance/kernels/tiles_llvm.py": (
        "_build_product",
        "copy_runs",
        "negative",
        "solve_lower",
        "solve_upper",
        "subtract",
    ),
    "service/factorbus/solver/covariance/kernels/tiles_plain.py": ("copy_runs", "negative", "subtract"),
    "service/factorbus/solver/covariance/kernels/whole.py": ("put_column", "whole_blocks"),
    "service/factorbus/solver/kernels/graph/admit.py": ("admit_factors", "admit_variables", "append_variable"),
    "service/factorbus/solver/kernels/graph/admit_bytes.py": ("take_factor", "take_groups", "take_variable"),
    "service/factorbus/solver/kernels/graph/block_pattern.py": ("connect",),
    "service/factorbus/solver/kernels/graph/initialize.py": ("reach", "reach_on"),
    "service/factorbus/solver/kernels/graph/local_init.py": ("gather_system", "settle_new"),
    "service/factorbus/solver/kernels/inc_l/block_rows.py": ("append_rows", "reach_rows", "spread", "take_fronts"),
    "service/factorbus/solver/kernels/inc_l/dense_update.py": ("add_omega", "dense_omega_update", "write_tail"),
    "service/factorbus/solver/kernels/inc_l/lambda_update.py": (
        "fill_row",
        "lambda_update",
        "renew_structure",
        "take_product",
    ),
    "service/factorbus/solver/kernels/inc_l/omega_update.py": (
        "apply",
        "join_lists",
        "omega_update",
        "reflect",
        "sweep",
        "whitened",
        "widen_to",
    ),
    "service/factorbus/solver/kernels/jit/simd_checked.py": ("tile",),
    "service/factorbus/solver/kernels/jit/simd_llvm.py": ("six", "tile"),
    "service/factorbus/solver/kernels/jit/simd_plain.py": ("tile",),
    "service/factorbus/solver/kernels/model/camera.py": ("sight",),
    "service/factorbus/solver/kernels/model/candidates.py": ("evaluate_factors",),
    "service/factorbus/solver/kernels/model/kinds.py": ("_other_residual", "linear_plane"),
    "service/factorbus/solver/kernels/model/linear.py": ("add_end", "add_vector", "linear", "linear_se2"),
    "service/factorbus/solver/kernels/model/linearize.py": ("add_factor", "add_other"),
    "service/factorbus/solver/kernels/sparse/amd.py": ("_merge_twins", "_update", "eliminate"),
    "service/factorbus/solver/kernels/sparse/multifrontal.py": ("factorize",),
    "service/factorbus/solver/kernels/sparse/panels.py": ("take_off", "take_panel_off"),
    "service/factorbus/solver/kernels/sparse/parallel_panels.py": ("take_panel_off_together",),
    "service/factorbus/solver/kernels/sparse/partial_cholesky.py": ("factor_front",),
    "service/factorbus/solver/kernels/sparse/symbolic.py": ("_block",),
    "workers/factorbus/idp/kernels/independent.py": ("independent",),
    "workers/factorbus/idp/kernels/minimal.py": ("half_rows", "rows"),
    "workers/factorbus/idp/kernels/pixels.py": ("observe",),
    "workers/factorbus/idp/kernels/rays.py": ("rays",),
}
FILES_LEFT = {
    "service/factorbus/service/solving/apply.py",
    "service/factorbus/solver/kernels/bayes_tree/step.py",
    "tests/service/test_quick_messages.py",
    "tests/solver/test_joints.py",
    "tests/solver/test_sights.py",
}
# Tables above, by file.
COLUMNS_LEFT = {
    "service/factorbus/solver/covariance/kernels/judge.py": ("sizes",),
    "service/factorbus/solver/kernels/bayes_tree/assemble.py": ("runs", "update"),
    "service/factorbus/solver/kernels/bayes_tree/commit.py": ("update",),
    "service/factorbus/solver/kernels/bayes_tree/refactor_in_place.py": ("old",),
    "service/factorbus/solver/kernels/sparse/multifrontal.py": ("blocks", "runs"),
    "service/factorbus/solver/kernels/sparse/symbolic.py": ("out", "runs"),
}
