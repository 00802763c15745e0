"""One vocabulary, docs/glossary.md: the words that it replaced are in no public name, help, wire field or page."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("proto", "service", "clients", "workers")

# Parts of names, between underscores and capitals, that have a standard word instead.
NAME_PARTS = (
    "errand", "courier", "ticket", "promise", "desk", "seat", "vitals", "lender", "doubt", "fold", "folds", "folded",
    "lookout", "polite", "discreet", "slip", "strain", "ripen", "ripe", "lacking", "sightseeing", "gauges", "whoever",
    "sight", "sights", "sighted", "sighting", "sightings", "border", "borders", "account", "accounts", "judged",
    "grown", "burden", "dearness", "glide",
)  # fmt: skip
NAMES = ("Folder", "Run", "Alone", "Judged", "Located", "Lane", "Trips", "Shares", "Lent", "Memories", "take_in",
    "Place", "Asked", "Told",
)  # fmt: skip
# Of the wire, options and statistics: whole words.
FIELDS = (
    "folded", "asleep", "points_below", "keyframe_key", "trip_ms", "lacking", "relinearised", "desk", "bent",
    "look_every", "ripple", "trust", "reluctance", "detour", "patience", "sightings", "border", "account",
)  # fmt: skip
PROSE = re.compile(
    r"\b(errands?|courier|desk|lender|lookout|ripen|asleep|points_below|take_in|sightseeing|trip_ms"
    r"|sights?|sightings?|borders?)\b",
    re.IGNORECASE,
)
# As the reference pages and the command line's help have it: a value is reported, a process notified, an error shown.
TOLD = re.compile(r"\b(is told|are told|was told|were told|whoever|so many)\b", re.IGNORECASE)
BRITISH = re.compile(
    r"\b\w*(?:lineari|initiali|factori|marginali|optimi|minimi|normali|recogni|vectori|seriali|synchroni)"
    r"s(?:e|ed|es|er|ing|ation|ations)\b",
    re.IGNORECASE,
)  # fmt: skip


def public_names(tree: ast.Module) -> Iterator[str]:
    """Of a module: classes, functions, parameters, fields, constants; arguments by name, as a problem's detail has."""
    for node in ast.walk(tree):
        match node:
            case ast.ClassDef(name=name) | ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield name
            case ast.arg(arg=name):
                yield name
            case ast.keyword(arg=str(name)):
                yield name
            case ast.AnnAssign(target=ast.Name(id=name)):
                yield name


def parts_of(name: str) -> set[str]:
    """`LentCores` is lent, cores; `next_fold` is next, fold."""
    return {part.lower() for part in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", name)}


def modules() -> list[Path]:
    return [path for root in SOURCES for path in sorted((ROOT / root / "factorbus").rglob("*.py"))]


def pages() -> list[Path]:
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found += [ROOT / root / name for root in SOURCES for name in ("README.md", "MATH.md")]
    return [page for page in found if page.exists() and "decisions" not in page.parts]


@pytest.mark.parametrize("root", SOURCES)
def test_public_names_are_those_of_the_glossary(root: str) -> None:
    found = set()
    for path in modules():
        if path.is_relative_to(ROOT / root) and "kernels" not in path.parts:
            for name in public_names(ast.parse(path.read_text(encoding="utf-8"))):
                if not name.startswith("_") and (name in NAMES or parts_of(name) & set(NAME_PARTS)):
                    found.add(f"{path.relative_to(ROOT)}: {name}")
    assert found == set()


def test_fields_of_the_wire_are_those_of_the_glossary() -> None:
    found = []
    for path in sorted((ROOT / "proto" / "vectors").rglob("*.json")):
        names: set[str] = set()
        json.loads(path.read_text(encoding="utf-8"), object_hook=lambda each, names=names: names.update(each))
        found += [f"{path.relative_to(ROOT)}: {name}" for name in sorted(names & set(FIELDS))]
    assert found == []


def test_help_and_pages_use_the_words_of_the_glossary() -> None:
    texts = [*pages(), *(path for path in modules() if "cli" in path.parts)]
    found = []
    for path in texts:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if match := PROSE.search(line) or TOLD.search(line) or BRITISH.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {match[0]}")
    assert found == []


@pytest.mark.parametrize("page", ["docs/glossary.md", "CONTRIBUTING.md"])
def test_a_page_that_says_where_things_are_names_places_that_there_are(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8").partition("## Your first factor kind")[0]
    places = set(re.findall(r"`([a-z_0-9]+(?:/[a-z_0-9]+)*\.py)`", text))
    assert places
    there = [path.as_posix() for path in modules()]
    assert {place for place in places if not any(path.endswith("/" + place) for path in there)} == set()


def test_functions_that_contributing_names_are_where_it_says() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Your first factor kind")[0]
    named = re.findall(r"`([a-z_0-9]+(?:/[a-z_0-9]+)*\.py)`: `([A-Za-z_]+)`", text)
    assert named
    for place, name in named:
        (path,) = [path for path in modules() if path.as_posix().endswith("/" + place)]
        assert re.search(rf"^\s*(?:def |class )?{name}\b", path.read_text(encoding="utf-8"), re.MULTILINE), (
            place,
            name,
        )
