"""What a person sees: progress on standard error, the result on standard output.  rich is imported when needed."""

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.progress import Progress


def print_note(text: str) -> None:
    """A line about what is going on, to standard error."""
    click.echo(text, err=True)


def document(content: Mapping[str, Any]) -> None:
    """The one JSON document of `--json`.  What is not finite becomes null: JSON has no word for it."""
    click.echo(json.dumps(_strict(content), indent=2, default=str))


def table(rows: Iterable[tuple[str, str]], title: str = "") -> None:
    """Names and values, to standard output."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    lines = Table(box=box.SIMPLE_HEAD, show_header=False, pad_edge=False)
    lines.add_column(style="bold", no_wrap=True)
    lines.add_column(overflow="fold")
    for name, value in rows:
        lines.add_row(name, value)
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=120)
    if title:  # not the table's own, which would be no wider than its columns
        console.print(Text(title, style="table.title"))
    console.print(lines)


@contextmanager
def progress(what: str, total: int | None) -> Iterator[Callable[[int, str], None]]:
    """A bar on standard error while inside; call what it gives with how far and a word on how it goes."""
    with _bar() as bar:
        task = bar.add_task(what, total=total, word="")

        def show(done: int, word: str = "") -> None:
            bar.update(task, completed=done, word=word)

        yield show


@contextmanager
def reading(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar that goes when it is done, where there is a terminal; call what it gives with how far and of how many."""
    with ExitStack() as shown:
        bar = None

        def show(done: int, total: int) -> None:
            nonlocal bar
            if bar is None:  # what is read at once has none
                bar = shown.enter_context(_bar(transient=True))
                bar.add_task(f"reading {what}", total=total or None, word="")
            bar.update(bar.task_ids[0], completed=done)

        yield show if sys.stderr.isatty() else lambda *_: None


def _bar(transient: bool = False) -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[word]}"),
        console=Console(stderr=True, highlight=False),
        refresh_per_second=8,
        transient=transient,
    )


def _strict(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):  # a numpy number or array
        return _strict(value.tolist())
    return value
