"""`factorbus explain`: what an error code means, and what to do."""

import difflib
import re
import shutil
import textwrap
from pathlib import Path

import click

from factorbus.cli.output.console import document
from factorbus.cli.output.exits import USAGE, Stopped
from factorbus.cli.process.options import json_option

_PAGES = Path(__file__).parents[1] / "codes.md"
# Exceptions whose code is not their name in another spelling.
_CODES = {
    "bad_expression": "unknown_kind",
    "apart": "not_positive_definite", "bad_configuration_file": "bad_file", "broken": "internal",
    "closed_here": "unavailable", "factors_of_another": "wrong_epoch", "interest_ended": "busy",
    "no_mirror": "unavailable", "not_finite_numbers": "not_finite",
    "not_held": "unknown_variable", "not_recorded": "no_journal", "not_reached": "unavailable",
    "dataset_problem": "problem", "format_error": "bad_file",
    "bad_parameters": "bad_file", "bad_recording": "bad_file",
    "map_there": "map_exists", "no_pose": "unknown_variable", "nobody_listens": "unavailable",
    "not_here": "unknown_map", "missing_variables": "unknown_variable",
    "not_in_map": "unknown_variable", "solver_error": "problem",
    "unsafe_config": "unsafe_folder", "unsafe_journal": "unsafe_folder", "unsafe_keys": "unsafe_folder",
    "unusable": "internal",
}  # fmt: skip


@click.command()
@click.argument("code", required=False)
@json_option
def command(code: str | None, as_json: bool) -> None:
    """Say what the error CODE means and what to do about it; without CODE, list all of them.

    The code of an error is what stands in brackets behind it. The name of an exception, such as NotConverged, does too.

    \b
    factorbus explain underconstrained
    factorbus explain NotConverged
    factorbus explain
    """
    pages = read_pages()
    if code is None and as_json:
        document({"codes": {name: _summary(text) for name, text in pages.items()}})
        return
    if code is None:
        width = shutil.get_terminal_size((120, 24)).columns
        for name, text in pages.items():
            line = f"{name:<22} {_summary(text)}"
            click.echo(textwrap.fill(line, width, subsequent_indent=23 * " ", break_on_hyphens=False))
        return
    name = code_of(code)
    if name not in pages:
        near = difflib.get_close_matches(name, pages, n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else "factorbus explain lists all of them"
        wanted = "a code that factorbus explain lists"
        raise Stopped("unknown_code", f"there is no error code {name!r}; {hint}", USAGE, seen=name, wanted=wanted)
    if as_json:
        document({"code": name, "text": pages[name]})
        return
    click.echo(f"{name}\n\n{pages[name]}")


def code_of(word: str) -> str:
    """The code that `word` means: itself, in brackets or not, or the name of an exception; in whatever case."""
    spelt = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", word.strip("[] ").rpartition(".")[2]).lower()
    bare = {name.replace("_", ""): name for name in (*read_pages(), *_CODES)}
    found = bare.get(spelt.replace("_", "").replace("-", ""), spelt)
    return _CODES.get(found, found)


def _summary(page: str) -> str:
    """The first sentence, whole: a page has lines of its own."""
    return re.split(r"(?<=[.]) (?=[A-Z`])", " ".join(page.split()), maxsplit=1)[0]


def read_pages() -> dict[str, str]:
    """Code → its page, from the file beside this one."""
    text = _PAGES.read_text(encoding="utf-8")
    return {name: page.strip() for name, page in re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", text, re.M | re.S)}
