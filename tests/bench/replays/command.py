"""What the commands `bench paper` and `bench peers` have in common: their options, and where results go."""

import argparse
import json
from pathlib import Path
from typing import Any


def add_options(parser: argparse.ArgumentParser, name: str, repetitions: int | None) -> None:
    """Options of both; results are kept in out/bench/`name`."""
    parser.add_argument("--quick", action="store_true", help="small or shortened data sets, below two minutes")
    parser.add_argument("--only", default="", metavar="NAME,...", help="these only")
    parser.add_argument(
        "--json", nargs="?", const="-", type=file_named, metavar="FILE", help="the JSON document to FILE, or to -"
    )
    parser.add_argument("--repetitions", type=positive, default=repetitions, help="of every run; times are medians")
    parser.add_argument("--limit-s", type=float, default=1800.0, help="solver CPU seconds after which a run is ended")
    parser.add_argument("--fresh", action="store_true", help="measure again what the output folder has")
    parser.add_argument("--out", type=folder_named, default=Path(f"out/bench/{name}"), help="where results are kept")
    parser.add_argument("--no-figures", action="store_true", help="tables only")


def positive(text: str) -> int:
    """A number of things."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number}; wanted 1 or more")
    return number


def natural(text: str) -> int:
    """A number of things, 0 included."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{number}; wanted 0 or more")
    return number


def file_named(text: str) -> str:
    """A file to write, or "-".  Measuring takes hours, so a path that cannot be written is refused before."""
    path = Path(text)
    if text != "-" and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise argparse.ArgumentTypeError(f"{text!r}; wanted a file in a folder that is there")
    return text


def folder_named(text: str) -> Path:
    """A folder to write to, which need not be there."""
    if not next(each for each in (Path(text).absolute(), *Path(text).absolute().parents) if each.exists()).is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}; wanted a folder")
    return Path(text)


def hand_out(name: str, document: dict[str, Any], text: str, options: argparse.Namespace) -> None:
    """Markdown and JSON into the output folder, and to where they were asked for."""
    options.out.mkdir(parents=True, exist_ok=True)
    content = json.dumps(document, indent=2)
    (options.out / f"{name}.md").write_text(text)
    (options.out / f"{name}.json").write_text(content)
    if options.json == "-":
        print(content)
        return
    if options.json:
        Path(options.json).write_text(content)
    figures = [Path(path).name for path in document.get("figures", ())]
    print(text)
    print(f"In {options.out}: {', '.join([f'{name}.md', f'{name}.json', *figures])}")
