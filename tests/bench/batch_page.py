"""The page of the docs with whole graphs, out of a document of `bench batch`."""

import time
from typing import Any

from bench.batch_solvers import BATCH_SOLVERS, OURS, OURS_ALONE

ELSEWHERE = 1.01  # an end above this, in χ² of the lowest, is no optimum: its time says nothing
_WORDS = """CPU time of a whole graph, from the values of its file, from composed odometry or from values that a world
comes with (given), to convergence: GTSAM's Levenberg-Marquardt and Gauss-Newton (multifrontal Cholesky), g2o's (Eigen's
sparse Cholesky, with points marginalized in `bundle`), all in one process, in turn, with the same values in memory;
ordering is on the clock, reading files is not. *This start*: factorbus from
where the others begin, and in brackets how many times that they take. *Best of three starts* is what `factorbus solve`
does: it also tries composed odometry and averaged rotations, and takes the best. Who ends elsewhere, more than 1 %
above the lowest χ² that any found, is shown with how many times as much."""


def page(result: dict[str, Any], arguments: list[str]) -> str:
    """result: the document; arguments: of the command that measured it."""
    machine, rows = result["machine"], result["rows"]
    versions = {name: each for row in rows for name, each in row["versions"].items()}
    names = [each.name for each in BATCH_SOLVERS if any(row["solver"] == each.name for row in rows)]
    heads = {OURS: "best of three starts", OURS_ALONE: "this start"}
    others = [name for name in names if name not in heads]
    head = ["graph", "from", "χ²", *(heads[name] for name in (OURS_ALONE, OURS) if name in names), *others]
    lines = [_line(head), _line(["---", "---", *["---:"] * (len(head) - 2)])]
    for graph, start in dict.fromkeys((row["dataset"], row["start"]) for row in rows):
        here = {row["solver"]: row for row in rows if (row["dataset"], row["start"]) == (graph, start)}
        lowest = min(row["chi2"] for row in here.values() if row["status"] == "done")
        beside = here[OURS_ALONE] if _is_there(here[OURS_ALONE], lowest) else here[OURS]
        cells = [graph, start, f"{lowest:.6g}", _cell(here[OURS_ALONE], lowest, None), _cell(here[OURS], lowest, None)]
        lines.append(_line([*cells, *(_cell(here[name], lowest, beside["cpu_s"]) for name in others)]))
    missed = [f"- MISSED: {each['what']}: {each['seen']}" for each in result["targets"] if not each["met"]]
    mean = result["targets"][-1]
    command = " ".join(["factorbus bench batch", *arguments])
    return "\n\n".join(
        [
            "# Whole graphs",
            f"What `{command}` found, on {time.strftime('%Y-%m-%d')}, on one core: {machine['cpu']} "
            f"({machine['cores']} cores), seed {result['seed']} of the simulated worlds, with "
            f"{', '.join(f'{name} {each}' for name, each in sorted(versions.items()))}, python {result['python']}.",
            _WORDS,
            "\n".join(lines),
            f"{mean['what']}: {mean['seen']}; over the best of three starts: {result['best_of_starts']:.2f}.",
            f"{len(result['targets']) - len(missed)} of {len(result['targets'])} targets are met"
            + ("." if not missed else ". The others:\n\n" + "\n".join(missed)),
        ]
    ) + "\n"  # fmt: skip


def _is_there(row: dict[str, Any], lowest: float) -> bool:
    return row["status"] == "done" and row["chi2"] <= ELSEWHERE * lowest


def _cell(row: dict[str, Any], lowest: float, ours_s: float | None) -> str:
    if row["status"] != "done":
        return "failed"
    if not _is_there(row, lowest):
        return f"{row['chi2'] / lowest:.3g} × χ²"
    seconds = f"{1e3 * row['cpu_s']:.3g} ms" if row["cpu_s"] < 1.0 else f"{row['cpu_s']:.3g} s"
    return seconds if ours_s is None else f"{seconds} ({row['cpu_s'] / ours_s:.1f} ×)"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
