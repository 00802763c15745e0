"""`factorbus datasets`: the public data sets, listed, fetched and checked."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output import console as screen
from factorbus.cli.output.exits import BAD_FILE, FAILED, OK, UNAVAILABLE, USAGE, Stopped
from factorbus.cli.process.options import Number, json_option
from factorbus.cli.process.stopping import interrupt_on_sigterm
from factorbus.datasets import (
    CATALOGUE,
    Dataset,
    DatasetProblem,
    Places,
    check_dataset,
    dataset_named,
    fetch_dataset,
    find,
    locate,
)
from factorbus.datasets.download import GITHUB

_EXITS = {
    "unknown_dataset": USAGE,
    "bad_address": USAGE,
    "bad_checksum": BAD_FILE,
    "bad_source": BAD_FILE,
    "cannot_read": BAD_FILE,
    "unreachable": UNAVAILABLE,
    "http_status": UNAVAILABLE,
    "broken_download": UNAVAILABLE,
}

_FOUND = {"own": "FACTORBUS_DATASETS", "cache": "cache", "wheel": "gtsam wheel"}


@click.group(invoke_without_command=True)
@json_option
@click.pass_context
def command(context: click.Context, as_json: bool) -> None:
    """The public data sets: where each is, and how good its best known solution is.

    They are looked for in the folder FACTORBUS_DATASETS, then in the cache, then in what the gtsam wheel ships (which
    is converted when it is used). None of them comes with factorbus: each is fetched from its public place.

    \b
    factorbus datasets
    factorbus datasets fetch intel
    factorbus replay intel

    \b
    In the list:
      poses, landmarks    vertices of each kind
      edges               pose to pose, and pose to landmark
      χ²                  Σ rᵀ Ω r at the best known solution (residuals of g2o, vertex 0 fixed)
    """
    if context.invoked_subcommand is not None:
        return
    places = Places.of_this_machine()
    with _exit_codes():
        rows = [_row(dataset, places) for dataset in _catalogue(context)]
    if as_json:
        screen.document({"cache": str(places.cache), "own": places.own and str(places.own), "datasets": rows})
    else:
        _show(rows, places)


@command.command("fetch")
@click.argument("names", nargs=-1, metavar="NAME...")
@click.option("--all", "everything", is_flag=True, help="All of them, some 15 MB.")
@click.option(
    "--from",
    "base",
    default=GITHUB,
    show_default=True,
    envvar="FACTORBUS_DATASETS_URL",
    metavar="URL",
    help="Where repository/commit/path are found: a mirror (or FACTORBUS_DATASETS_URL).",
)
@click.option(
    "--timeout",
    "timeout_s",
    type=Number(0, min_open=True),
    default=30,
    show_default=True,
    metavar="S",
    help="Give up after S seconds without an answer.",
)
@click.option("--keep-source", is_flag=True, help="Leave the downloaded source in the cache, too (sources/NAME).")
@json_option
@click.pass_context
def fetch_command(
    context: click.Context, names: tuple[str, ...], everything: bool, as_json: bool, **how: Any
) -> int | None:
    """Get data sets into the cache: download, check, convert, check again.

    With several names, one that fails does not stop the others; the exit code is that of the first failure.

    \b
    factorbus datasets fetch intel manhattan3500
    factorbus datasets fetch --all
    factorbus datasets fetch intel --from https://mirror.example/raw
    """
    if everything == bool(names):
        raise click.UsageError("wanted names, or --all for all of them")
    places = Places.of_this_machine()
    with _exit_codes():
        chosen = _catalogue(context) if everything else [dataset_named(name, _catalogue(context)) for name in names]
    failures: list[Stopped] = []
    rows = []
    with interrupt_on_sigterm():
        for dataset in chosen:
            try:
                with _exit_codes(), _bars(dataset.name) as watch:
                    path = fetch_dataset(dataset, places.cache, wheel=places.wheel, watch=watch, **how)
                rows.append({"name": dataset.name, "path": str(path)})
                if not as_json:
                    click.echo(str(path))
            except Stopped as stopped:
                if len(chosen) == 1:
                    raise
                screen.print_note(f"factorbus: {stopped.message} [{stopped.code}]")
                problem = {"code": stopped.code, "message": stopped.message, "detail": stopped.detail}
                rows.append({"name": dataset.name, "problem": problem})
                failures.append(stopped)
    if as_json:
        screen.document({"datasets": rows})
    if failures:
        screen.print_note(f"{len(failures)} of {len(chosen)} could not be fetched")
    return failures[0].exit_code if failures else OK


@command.command("check")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@json_option
@click.pass_context
def check_command(context: click.Context, names: tuple[str, ...], as_json: bool) -> int:
    """Hold what is found against the catalogue's SHA-256: all, or NAMEs.

    The exit code is 3 when a file is not what it should be, 1 when a NAME is not found.

    \b
    factorbus datasets check
    factorbus datasets check intel
    """
    places = Places.of_this_machine()
    with _exit_codes():
        chosen = [dataset_named(name, _catalogue(context)) for name in names] or _catalogue(context)
        rows = [_judged(dataset, places) for dataset in chosen]
    if as_json:
        screen.document({"good": not any(row["state"] == "bad" for row in rows), "datasets": rows})
    else:
        screen.table([(row["name"], row["says"]) for row in rows], title="factorbus datasets check")
    if any(row["state"] == "bad" for row in rows):
        return BAD_FILE
    return FAILED if names and any(row["state"] == "missing" for row in rows) else OK


@command.command("path")
@click.argument("name")
@json_option
@click.pass_context
def path_command(context: click.Context, name: str, as_json: bool) -> None:
    """Print the path of data set NAME.

    What only the gtsam wheel has is converted into the cache first.

    \b
    factorbus replay $(factorbus datasets path intel)
    """
    with _exit_codes():
        path = find(name, Places.of_this_machine(), _catalogue(context))
        dataset = dataset_named(name, _catalogue(context))
    if path is None:
        raise Stopped("not_found", f"{dataset.name} is not on this machine: factorbus datasets fetch {dataset.name}")
    if as_json:
        screen.document({"name": dataset.name, "path": str(path)})
    else:
        click.echo(str(path))


def _catalogue(context: click.Context) -> Sequence[Dataset]:
    return CATALOGUE if context.obj is None else context.obj


@contextmanager
def _exit_codes() -> Iterator[None]:
    """A problem with a data set becomes the end of the command.  Raises Stopped."""
    try:
        yield
    except DatasetProblem as problem:
        exit_code = _EXITS.get(problem.code, FAILED)
        raise Stopped(problem.code, problem.message, exit_code, **problem.detail) from problem


@contextmanager
def _bars(name: str) -> Iterator[Callable[[str, int, int | None], None]]:
    """A bar for each file that is downloaded, from its first bytes on."""
    with ExitStack() as stack:
        bars: dict[str, Callable[[int, str], None]] = {}

        def watch(file: str, done: int, total: int | None) -> None:
            if file not in bars:
                bar = screen.progress(f"{name}, KiB", None if total is None else -(-total // 1024))
                stack.close()
                bars[file] = stack.enter_context(bar)
            bars[file](-(-done // 1024), file)

        yield watch


def _row(dataset: Dataset, places: Places) -> dict[str, Any]:
    place = locate(dataset, places)
    sources = (dataset.download, dataset.wheel)
    return {
        "name": dataset.name,
        "paper": dataset.paper or None,
        "what": dataset.what,
        "kind": dataset.kind,
        "poses": dataset.poses,
        "landmarks": dataset.landmarks,
        "edges": dataset.edges,
        "landmark_edges": dataset.observations,
        "vertex_lines": dataset.vertices,
        "chi2_optimum": dataset.optimum,
        "sha256": dataset.sha256,
        "sources": [source.where for source in sources if source],
        "found": place and {"in": place.where, "path": str(place.path)},
        "near": dataset.near or None,
    }


def _show(rows: Sequence[dict[str, Any]], places: Places) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    lines = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for title in ("name", "in the paper", "poses", "landmarks", "edges", "χ²", "found"):
        lines.add_column(title, justify="right" if title in ("poses", "landmarks", "edges", "χ²") else "left")
    for row in rows:
        lines.add_row(
            row["name"],
            row["paper"] or "",
            str(row["poses"]),
            str(row["landmarks"] or ""),
            str(row["edges"] + row["landmark_edges"]),
            f"{row['chi2_optimum']:.8g}",
            _FOUND[row["found"]["in"]] if row["found"] else "no",
        )
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=120)).print(lines)
    click.echo(f"cache: {places.cache}" + (f"   FACTORBUS_DATASETS: {places.own}" if places.own else ""))
    for row in rows:
        if row["near"] and not row["found"]:
            click.echo(f"not {row['name']}, though near: {row['near']}")
    if missing := [row["name"] for row in rows if not row["found"]]:
        click.echo(f"to get the rest: factorbus datasets fetch {missing[0] if len(missing) == 1 else '--all'}")


def _judged(dataset: Dataset, places: Places) -> dict[str, Any]:
    place = locate(dataset, places)
    if place is None:
        says = f"not found: factorbus datasets fetch {dataset.name}"
        return {"name": dataset.name, "state": "missing", "path": None, "says": says}
    path: Path = place.path
    if place.where == "wheel":  # located by its checksum
        return {"name": dataset.name, "state": "good", "path": str(path), "says": f"good source: {path}"}
    verdict = check_dataset(dataset, path)
    says = f"good: {path}"
    if not verdict.good:
        says = f"BAD: {path} has SHA-256 {verdict.seen}, wanted {verdict.wanted}; fetch it again"
    return {"name": dataset.name, "state": "good" if verdict.good else "bad", "path": str(path), "says": says}
