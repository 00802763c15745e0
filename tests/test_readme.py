"""Every block of code in the README runs, as it stands there; so do those of the guides beside the code."""

import os
import re
import subprocess
from pathlib import Path

import click
import numpy as np
import pytest
from walk import ROOT, SCRIPTS, blocks, walker


@pytest.mark.alone  # 2,000 steps as fast as they go: a viewer that is not given a core in time misses some, and says so
@pytest.mark.timeout(300)
def test_make_demo() -> None:
    """In the repository, where set-up has been made; only the virtual environment is that of the tests."""
    (_, first) = blocks("README.md")[0]
    environment = str(SCRIPTS.parent)
    arguments = [*first.split(), f"VENV={environment}", f"--assume-old={environment}/.ready"]
    ran = subprocess.run(arguments, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=280, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "every one: 2,000 steps, 2,000 by the robot, 2,000 by the viewer" in ran.stdout
    assert (ROOT / "out" / "demo.png").stat().st_size > 20_000


def test_the_rest_of_the_readme(tmp_path: Path) -> None:
    demo, simulated, serve, program = blocks("README.md")
    assert (demo[0], demo[1].split()[:2]) == ("bash", ["make", "demo"])
    with walker(tmp_path) as run:
        said = run(*simulated)
        assert said.count("χ² / batch at") == 5
        assert {"town.g2o", "town.png", "town.tum"} == {path.name for path in tmp_path.iterdir()}
        assert len((tmp_path / "town.tum").read_text().splitlines()) == 1000
        run(*serve)
        for _ in range(2):  # a second try is not met with an error
            before, after = (line.split("at", 1)[1] for line in run(*program).splitlines())
            assert distance(before) > 0.05
            assert distance(after) < distance(before) / 10


def test_the_client_librarys_guide(tmp_path: Path) -> None:
    programs = [block for block in blocks("clients/README.md") if block[0] == "python"]
    assert len(programs) == 8
    with walker(tmp_path) as run:
        run("bash", "factorbus serve")
        run(*programs[0])
        said = [run(*program) for program in programs]
    assert "unknown_variable" in said[3]
    assert said[4].rstrip().endswith("False")
    pose, raw = re.findall(r"\[[^]]+\]", said[5])
    assert pose == raw
    assert said[5].endswith("] 0.0\n")
    stamp, *trajectory = re.findall(r"\d{19}|\d{10}\.\d{9}", said[6])
    assert [line.replace(".", "") for line in trajectory[-2:]] == trajectory[:2]
    assert stamp == trajectory[1]
    assert said[7] == "2\n[1. 0. 0.]\n"


def test_the_filter_front_end_of_the_workers_guide(tmp_path: Path) -> None:
    (program,) = (block for block in blocks("workers/README.md") if block[0] == "python")
    (console,) = (block for block in blocks("workers/README.md") if block[0] == "console")
    with walker(tmp_path) as run:
        run("bash", "factorbus serve --no-warm")
        first, second, third = run(*program).splitlines()
        run(*console)
    assert first == "the state has 31 numbers, made by in-place"
    angles, block = (np.array(re.findall(r"-?\d+\.\d+(?:e-?\d+)?", line), float) for line in (second, third))
    np.testing.assert_allclose(angles, [-0.55, 0.33], atol=0.05)
    assert block.size == 4


def test_the_services_guide(tmp_path: Path) -> None:
    from factorbus.service.config import load_config

    (console,) = (block for block in blocks("service/README.md") if block[0] == "console")
    with walker(tmp_path) as run:
        run(*console)
    (settings,) = (text for language, text in blocks("service/README.md") if language == "toml")
    (tmp_path / "serve.toml").write_text(settings)
    assert load_config(tmp_path / "serve.toml").limits.waiting == 1024


def test_every_block_of_every_guide_is_run_or_checked() -> None:
    """A language that nothing here or in `test_docs.py` runs would go unseen."""
    guides = ("README.md", "service/README.md", "workers/README.md", "clients/README.md")
    assert {language for guide in guides for language, _ in blocks(guide)} == {"bash", "console", "python", "toml"}


def test_make_targets_that_documents_name_exist() -> None:
    documents = [ROOT / "CONTRIBUTING.md", ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    named = {each for path in documents for each in re.findall(r"(?:^|`)make ([a-z-]+)", path.read_text(), re.M)}
    assert {"demo", "docs"} <= named
    assert named <= set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))


def test_commands_of_the_table_are_all_there_are() -> None:
    from factorbus.cli.main import COMMANDS

    text = (ROOT / "README.md").read_text()
    section = text[text.index("## Commands") : text.index("`factorbus COMMAND --help`")]
    told = {words.split()[0] for words in re.findall(r"`([^`]+)`", section)}
    assert told == set(COMMANDS) - {"robot", "version"}


def test_commands_said_not_to_print_json_are_those_that_do_not() -> None:
    from factorbus.cli.main import COMMANDS, cli

    text = (ROOT / "README.md").read_text()
    section = text[text.index("`--json` prints one") : text.index("Exit codes:")]
    told = {words.split()[0] for words in re.findall(r"`([^`]+)`", section)} - {"--json"}
    with click.Context(cli) as context:
        found = {name: cli.get_command(context, name) for name in COMMANDS if name != "robot"}
    assert told == {name for name, command in found.items() if command is not None and not prints_json(command)}


def prints_json(command: click.Command) -> bool:
    """It has the option, or one of its own commands does."""
    own = command.commands.values() if isinstance(command, click.Group) else ()
    return any("--json" in option.opts for option in command.params) or any(map(prints_json, own))


def test_the_table_of_extras_says_what_commands_ask_for() -> None:
    """In the source: `require("viz", "factorbus demo")`, or with an option that needs it."""
    text = (ROOT / "docs" / "reference" / "commands.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", text[text.index("| extra |") :], re.M))
    asked = set()
    for path in (ROOT / "clients" / "factorbus" / "cli").rglob("*.py"):
        for extra, what in re.findall(r'require\("(\w+)", "([^"]+)"\)', path.read_text()):
            command = what.removeprefix("factorbus ") if what.startswith("factorbus ") else f"{path.stem} {what}"
            asked.add((extra, command))
    assert len(asked) > 15
    told = {extra: set(re.findall(r"`([^`]+)`", row)) for extra, row in rows.items()}
    assert set(told) == {extra for extra, _ in asked} | {"bench"}
    known = lambda extra, command: any(command.startswith(each) for each in told[extra])  # noqa: E731
    missing = {(extra, command) for extra, command in asked if not known(extra, command)}
    # Options of `plot` that solve: the page of --help says so.
    assert missing <= {("service", "plot_source --solve"), ("service", "plot_source --ellipses of a file")}


def test_numbers_beside_peers_are_those_of_the_page_that_the_bench_writes() -> None:
    text = (ROOT / "README.md").read_text()
    section = text[text.index("## Beside its peers") : text.index("## Commands")]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    page = (ROOT / "docs" / "choosing" / "results.md").read_text().splitlines()
    assert len(lines) > 5
    assert [line for line in lines if line not in page] == []


def distance(said: str) -> float:
    """From the origin, of the first `[x y ...]` in what was printed."""
    x, y = (float(number) for number in said[said.index("[") + 1 :].replace("]", " ").split()[:2])
    return (x * x + y * y) ** 0.5
