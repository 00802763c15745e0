"""Counts have the noun that belongs to them, in every text for people."""

import re
from pathlib import Path

import pytest

from factorbus.formats.left_out import LeftOut
from factorbus.solver.errors import Underconstrained
from factorbus.wording import counted

ROOT = Path(__file__).resolve().parents[1]
X1 = ord("x") << 56 | 1


@pytest.mark.parametrize(
    ("count", "said"),
    [(0, "0 factors"), (1, "1 factor"), (2, "2 factors"), (12345, "12,345 factors")],
)
def test_a_count_has_its_noun(count: int, said: str) -> None:
    assert counted(count, "factor") == said


def test_a_plural_of_its_own() -> None:
    assert [counted(n, "vertex", "vertices") for n in (0, 1, 2)] == ["0 vertices", "1 vertex", "2 vertices"]


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        ([], "nothing holds x1: no factor is on it; add a prior"),
        (["f"], "x1 is not fixed by its 1 factor (f): add a prior"),
        (["f", "g"], "x1 is not fixed by its 2 factors (f, g): add a prior"),
        (["f"] * 9, "x1 is not fixed by its 9 factors (f, f, f, f, f, f, f, f, ...): add a prior"),
    ],
)
def test_what_leaves_a_variable_free_is_counted(factors: list[str], said: str) -> None:
    problem = Underconstrained(X1, factors, "add a prior")
    assert problem.message == said
    assert problem.detail["factors"] == factors


def test_no_text_leaves_the_choice_to_the_reader() -> None:
    """`1 factor(s)`, and an s that is put on by hand beside the one way that there is."""
    found = []
    for root in ("proto", "service", "workers", "clients"):
        for path in sorted((ROOT / root / "factorbus").rglob("*.py")):
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                if re.search(r"[a-z]{3}\(s\)[ ,.:;{(]*[^)]*\"|'s' if |\"s\" if ", line):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert found == []


def test_no_count_stands_before_a_bare_plural() -> None:
    """`{len(poses)} poses` says "1 poses": `counted(len(poses), "pose")` does not.  Constants above one may."""
    plural = re.compile(
        r"\{(?:len\([^{}]*\)|[^{}]*(?:\.size|count|\.sum\(\)|\['[a-z_]+'\]))(?::,)?\} (?:[a-z-]+ )?"
        r"(?:bytes|numbers|poses|points|variables|factors|steps|maps|inserts|clients|workers|records|lines|features|keys|"
        r"landmarks|closures|rows|fields|records|revisions|deltas|kernels|iterations|nonzeros|blocks)\b"
    )
    found = []
    for root in ("proto", "service", "workers", "clients"):
        for path in sorted((ROOT / root / "factorbus").rglob("*.py")):
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                if plural.search(line):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert found == []


def test_no_name_for_many_stands_behind_a_count_as_it_is() -> None:
    """`{count} {name}` says "1 poses" where the names are plurals, and "a {kind}" says "a se2"."""
    found = []
    for root in ("proto", "service", "workers", "clients"):
        for path in sorted((ROOT / root / "factorbus").rglob("*.py")):
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                if re.search(r"\{count\} \{name\}|\ba \{[a-z.]*\bgroup\.kind\}|\ba se[23]\b", line):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert found == []


def test_what_is_left_out_of_a_file_has_its_noun() -> None:
    """Every plural that `LeftOut` is given in the tree, once and twice."""
    plurals = {"poses", "landmarks", "factors"}  # that come in a variable
    for path in sorted((ROOT / "service" / "factorbus" / "formats").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        plurals |= set(re.findall(r"(?:\.drop\(|\.set_aside\(|\blost\[)\"([a-z ]+s)\"", text))
    assert len(plurals) > 6
    for name in sorted(plurals):
        left = LeftOut("a.g2o")
        left.drop(name, 1, "why")
        left.drop(name, 2, "why")
        one, many = left.notes
        assert many == f"2 {name} left out: why"
        assert not re.match(f"1 {name} ", one), one
