"""Every code that the source can give has a page."""

import ast
import json
import re
from pathlib import Path

import pytest

from factorbus.cli.commands.explain import code_of, read_pages
from factorbus.cli.main import main
from factorbus.cli.output.exits import OK, USAGE

ROOT = Path(__file__).resolve().parents[2]
# Bases of a tree of errors: never raised themselves.
BASES = {"problem", "solver_error", "dataset"}


def codes() -> set[str]:
    """From the source: `code = "..."` in a class, and the first word of `Stopped(...)` and `Refused(...)`."""
    found = set()
    for root in ("proto", "service", "workers", "clients"):
        for path in (ROOT / root / "factorbus").rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    found |= {
                        each.value.value
                        for each in node.body
                        if isinstance(each, ast.Assign)
                        and [t.id for t in each.targets if isinstance(t, ast.Name)] == ["code"]
                        and isinstance(each.value, ast.Constant)
                        and isinstance(each.value.value, str)
                    }
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("Stopped", "Refused") and node.args:
                    first = node.args[0]
                    if isinstance(first, ast.Constant) and isinstance(first.value, str):
                        found.add(first.value)
    return found


def test_every_code_has_a_page() -> None:
    pages, given = read_pages(), codes() - BASES
    assert given - set(pages) == set(), "write what these mean, and what to do, into clients/factorbus/cli/codes.md"
    assert "failed" in pages  # what an error without a code is shown as
    assert list(pages) == sorted(pages)
    headings = re.findall(r"^## (\w+)$", (ROOT / "clients/factorbus/cli/codes.md").read_text(encoding="utf-8"), re.M)
    assert len(headings) == len(pages), "a code has two pages: of which one is shown"
    assert all(len(text) > 40 for text in pages.values())


def test_codes_of_the_wire_contract_have_pages() -> None:
    text = (ROOT / "proto" / "README.md").read_text(encoding="utf-8")
    section = text[text.index("## 11. Problems") : text.index("## 12.")]
    told = {code for row in re.findall(r"^\| (`.*?) \|", section, re.M) for code in re.findall(r"`([a-z_]+)`", row)}
    assert len(told) > 20
    assert told <= set(read_pages())


def test_explain_says_it_and_guesses(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "[underconstrained]"]) == OK
    said = capsys.readouterr().out
    assert said.startswith("underconstrained\n\nThe factors leave a variable free to move")
    assert main(["explain", "underconstraind"]) == USAGE
    assert "did you mean underconstrained" in capsys.readouterr().err


def test_what_scripts_read_is_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "NotConverged", "--json"]) == OK
    pages = read_pages()
    assert json.loads(capsys.readouterr().out) == {"code": "not_converged", "text": pages["not_converged"]}
    assert main(["explain", "--json"]) == OK
    codes = json.loads(capsys.readouterr().out)["codes"]
    assert set(codes) == set(pages)
    assert all(" ".join(pages[name].split()).startswith(text) for name, text in codes.items())
    assert main(["explain", "nope", "--json"]) == USAGE
    assert json.loads(capsys.readouterr().out)["problem"]["code"] == "unknown_code"


def test_the_list_has_whole_sentences(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain"]) == OK
    entries = re.split(r"\n(?=\w)", capsys.readouterr().out.rstrip("\n"))
    pages = read_pages()
    assert [entry.split()[0] for entry in entries] == list(pages)
    for entry in entries:
        name, *words = entry.split()
        assert words[-1].endswith("."), f"{name} is cut"
        assert " ".join(pages[name].split()).startswith(" ".join(words))


def exceptions() -> set[str]:
    """The classes of the source that have a code of their own, or are public in the client library."""
    from factorbus import client

    named = {name for name in client.__all__ if isinstance(getattr(client, name), type)}
    found = {name for name in named if issubclass(getattr(client, name), BaseException)}
    for root in ("proto", "service", "workers", "clients"):
        for path in (ROOT / root / "factorbus").rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef) and any(
                    isinstance(each, ast.Assign)
                    and isinstance(each.targets[0], ast.Name)
                    and each.targets[0].id == "code"
                    for each in node.body
                ):
                    found.add(node.name)
    return found


def test_every_exception_is_found_by_its_name() -> None:
    found = exceptions()
    assert found >= {
        "NotConverged",
        "NoAnswerYet",
        "Refused",
        "Problem",
        "Unavailable",
        "KeyCollision",
        "Underconstrained",
    }
    pages = read_pages()
    assert sorted(name for name in found if code_of(name) not in pages) == []
    assert {code_of(word) for word in ("notconverged", "NOT_CONVERGED", "not-converged")} == {"not_converged"}
    assert {code_of(name) for name in ("ClosedHere", "NoMirror", "NotReached", "NobodyListens")} == {"unavailable"}
    assert code_of("formaterror") == "bad_file"
    assert code_of("factorbus.client.NotConverged") == code_of("[not_converged]") == "not_converged"


def test_what_stats_say_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    for word in ("gave_up", "NotConverged"):
        assert main(["explain", word]) == OK
    assert "left off improving its estimate" in capsys.readouterr().out
