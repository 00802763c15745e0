"""Every command with --json prints one document and nothing else on standard output, also where it was typed wrong."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest

from factorbus.cli.main import cli, main
from factorbus.cli.output.exits import FAILED, USAGE, Stopped, report

ROOT = Path(__file__).resolve().parents[2]
# Those that run until they are stopped: there is nothing to say at the end.
STAY = {("serve",), ("work",), ("gateway",), ("watch",), ("record",), ("ros2",)}


def commands_of(group: click.Group, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """All commands, with their words."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from commands_of(command, (*words, name))
        elif command is not None:
            yield (*words, name), command


ALL = dict(commands_of(cli))
COMMANDS = sorted(words for words, command in ALL.items() if any("--json" in each.opts for each in command.params))


def test_all_that_end_have_it() -> None:
    assert set(ALL) - set(COMMANDS) == STAY
    page = (ROOT / "docs/reference/commands.md").read_text()
    said = page[page.index("`--json` prints") : page.index("<!-- [commands]")]
    assert all(f"`{name}`" in said for (name,) in STAY)
    assert not any("--log" in each.opts for name in ("gateway", "watch", "record") for each in ALL[name,].params)


def test_there_are_many() -> None:
    assert {words[0] for words in COMMANDS} >= {"ask", "bench", "change", "convert", "demo", "maps", "solve", "stats"}


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("first", [True, False])
def test_wrong_use_is_a_document(words: tuple[str, ...], first: bool, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, *(("--json", "--nope") if first else ("--nope", "--json"))]) == USAGE
    said = capsys.readouterr()
    problem = json.loads(said.out)["problem"]
    assert problem["code"] == "bad_usage"
    # `budget` takes what begins with a minus for a number, and misses the other argument.
    wanted = "Missing argument" if words == ("budget",) else "--nope"
    assert wanted in problem["message"]
    assert wanted in said.err
    assert problem["detail"]["usage"] in said.err


@pytest.mark.parametrize(
    ("typed", "detail"),
    [
        (["change", "yard"], {"usage": "Usage: factorbus change [OPTIONS] COMMAND [ARGS]..."}),
        (["plot", "a.g2o"], {"commands": ["drive", "map", "sparsity", "tree"]}),
        (["ask", "covariance", "yard", "--jont"], {"nearest": ["--connect", "--joint", "--json"]}),
        (["replay", "-5"], {"hint": "A number below 0 is written behind `--`, and options before that: NAME -- -1"}),
        (["sove", "a.g2o"], {"usage": "Usage: factorbus [OPTIONS] COMMAND [ARGS]..."}),
    ],
)  # fmt: skip
def test_the_document_of_wrong_use_has_what_the_text_has(
    typed: list[str], detail: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*typed, "--json"]) == USAGE
    said = capsys.readouterr()
    problem = json.loads(said.out)["problem"]
    assert problem["detail"].items() >= detail.items()
    assert problem["message"] in said.err
    assert problem["detail"].get("hint", "") in said.err


def test_without_json_there_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["solve", "--nope"], ["maps", "--nope", "--", "--json"]):
        assert main(words) == USAGE
        assert capsys.readouterr().out == ""


def test_what_json_has_no_word_for_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    detail = {"seen": math.nan, "row": np.array([1.0, np.inf]), "of": ValueError("x")}
    assert report(Stopped("made_up", "of the test", **detail), as_json=True, debug=False) == FAILED
    said = json.loads(capsys.readouterr().out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert said["problem"]["detail"] == {"seen": None, "row": [1.0, None], "of": "x"}


def test_a_range_of_numbers_is_called_a_number_where_something_else_is_given() -> None:
    kinds = {(words, each.name): each.type for words, command in ALL.items() for each in command.params}
    plain = [where for where, kind in kinds.items() if kind.name in ("integer range", "float range")]
    assert plain == [], "use WholeNumber or Number of factorbus.cli.process.options"
