"""Progress of a benchmark on standard error: a bar for all jobs, and one for the present one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

Begin = Callable[[str, int], None]
Tell = Callable[[int, str], None]


@contextmanager
def bars(total: int) -> Iterator[tuple[Begin, Tell]]:
    """(begin, progress): begin(what, steps) the next of `total` jobs, 0 steps: nobody knows; progress(done, word)."""
    columns = (
        TextColumn("{task.description:34}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[word]}"),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console) as shown:
        jobs, job = shown.add_task("all", total=total, word=""), shown.add_task("", total=None, word="")
        begun = [0]

        def begin(what: str, steps: int) -> None:
            shown.update(jobs, completed=begun[0])
            begun[0] += 1
            shown.reset(job, description=what, total=steps or None, word="")
            if not console.is_terminal:
                console.print(f"[{begun[0]}/{total}] {what}", highlight=False)

        def progress(done: int, word: str) -> None:
            shown.update(job, completed=done, word=word)

        yield begin, progress
        shown.update(jobs, completed=total)
