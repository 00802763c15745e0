"""Rows as Markdown: the paper's Table 1, then a table with everything for each data set, the fill-in, the verdicts."""

from collections.abc import Sequence
from typing import Any

from .contestants import ENTRIES, OURS
from .targets import Verdict

_SHORT = {"failed": "failed", "limit": "> limit", "crashed": "crashed"}


def report(
    rows: Sequence[dict[str, Any]],
    fills: dict[str, dict[str, Any]],
    verdicts: Sequence[Verdict],
    notes: Sequence[str],
    machine: dict[str, Any],
) -> str:
    """The whole text."""
    parts = [
        "# Replays",
        f"{machine['cpu']}, one core; Python {machine['python']}; CPU seconds of the solver alone. {when(rows)}",
        *(f"> {note}" for note in notes),
        "## Table 1: seconds for a whole replay",
        table_1(rows),
        _LEGEND,
        "## Each data set",
    ]
    for dataset in dict.fromkeys(row["dataset"] for row in rows):
        mine = [row for row in rows if row["dataset"] == dataset]
        parts += [f"### {mine[0]['title']}: {mine[0]['steps']} steps", details(mine)]
        parts += [f"- {row['name']}: {row['note']}" for row in mine if row["status"] != "done"]
    if fills:
        parts += ["## Fill-in of R, final systems", fill_table(fills)]
    if verdicts:
        parts += ["## What it must show", verdict_list(verdicts)]
    return "\n\n".join(parts) + "\n"


def table_1(rows: Sequence[dict[str, Any]]) -> str:
    """Solvers as rows, data sets as columns, the best time of each column bold; ours below the line of the peers."""
    titles = {row["dataset"]: row["title"] for row in rows}
    cells = {(row["name"], row["dataset"]): row for row in rows}
    best = {
        dataset: min((row["cpu_s"] for row in rows if row["dataset"] == dataset and row["status"] == "done"), default=0)
        for dataset in titles
    }
    lines = [line(["", *titles.values()]), line(["---", *["---:"] * len(titles)])]
    for ours in (False, True):
        if ours:
            lines.append(line(["*ours*", *[""] * len(titles)]))
        for name, entry in ENTRIES.items():
            if (entry.solver == OURS) == ours and any(row["name"] == name for row in rows):
                lines.append(line([entry.label, *(_cell(cells.get((name, d)), best[d]) for d in titles)]))
    return "\n".join(lines)


def details(rows: Sequence[dict[str, Any]]) -> str:
    """All that was measured on one data set."""
    head = ["", "cpu s", "solve s", "read s", "wall s", "p50 ms", "p95", "p99", "max", "χ² end"]
    head += ["χ²/batch median", "p95", "max", "mean", "spikes", "nnz R", "MB", "steps by strategy"]
    lines = [line(head), line(["---", *["---:"] * (len(head) - 2), "---"])]
    for row in rows:
        step, quality = row["step_ms"], row["chi2_ratio"]
        size = "" if row["peak_mb"] is None else f"{row['peak_mb']:.0f} ({row['base_mb']:.0f})"
        cells = [ENTRIES[row["name"]].label]
        cells += [number(row[name], "{:.3f}") for name in ("cpu_s", "solve_s", "read_s", "wall_s")]
        cells += [number(step.get(name), "{:.3f}") for name in ("p50", "p95", "p99", "max")]
        cells.append(number(row["chi2_final"], "{:.8g}"))
        cells += [number(quality.get(name), "{:.5f}") for name in ("median", "p95", "max", "mean")]
        cells += [number(quality.get("spikes"), "{}"), number(row["nnz_r"], "{}"), size]
        cells.append(", ".join(f"{name} {count}" for name, count in row["strategies"].items()))
        lines.append(line(cells))
    return "\n".join(lines)


def fill_table(fills: dict[str, dict[str, Any]]) -> str:
    """Nonzeros of R by ordering."""
    head = ["", "scalars", "blocks", "blocks, constrained", "elements", "elements, constrained", "CHOLMOD AMD"]
    head += ["blocks / CHOLMOD", "price of the constraint", "with landmarks of 10 poses", "stored by full blocks"]
    lines = [line(head), line(["---", *["---:"] * (len(head) - 1)])]
    for dataset, fill in fills.items():
        nnz = fill["nnz"]
        names = ("blocks", "blocks_constrained", "elements", "elements_constrained", "cholmod_amd")
        cells = [dataset, str(fill["scalars"]), *(str(nnz[name]) for name in names)]
        cells += [f"{fill['against_cholmod']:.4f}", f"{100 * fill['price_of_constraint']:+.2f} %"]
        cells.append(f"{100 * fill['price_of_recent']:+.2f} %")
        cells.append(str(fill["stored_by_blocks"]))
        lines.append(line(cells))
    return "\n".join(lines)


def verdict_list(verdicts: Sequence[Verdict]) -> str:
    """One line for each."""
    return "\n".join(
        f"- **{verdict.verdict}** {verdict.what}{': ' + verdict.seen if verdict.seen else ''}" for verdict in verdicts
    )


def _cell(row: dict[str, Any] | None, best: float) -> str:
    if row is None:
        return ""
    if row["status"] != "done":
        return f"{_SHORT[row['status']]} ({row['done']} of {row['steps']})" if row["steps"] else _SHORT[row["status"]]
    text = f"{row['cpu_s']:.3f}" if row["cpu_s"] < 10 else f"{row['cpu_s']:.1f}"
    return f"**{text}**" if row["cpu_s"] == best else text


def number(value: Any, form: str) -> str:
    return "" if value is None else form.format(value)


def line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def when(rows: Sequence[dict[str, Any]]) -> str:
    times = sorted(row["measured_at"] for row in rows if row["measured_at"])
    loads = [row["load_average"] for row in rows if row["load_average"] is not None]
    if not times:
        return ""
    return f"Measured from {times[0]} to {times[-1]}, load average {min(loads):.1f} to {max(loads):.1f}."


_LEGEND = """\
Every solver gets the same steps, one a pose, and new variables start composed from its own estimate.

- Ours: staging and the step (*solve*), a copy of all values (*read*), every step.
- iSAM2: `update` with the back-substitution for the newest pose (*solve*), `calculateEstimate` (*read*), every step; \
building factors is outside the clock; relinearizeSkip 1, Gauss-Newton, wildfire 1e-3, a prior of 1e-4 on the first \
pose. A landmark seen as (x, y) is bearing and range for GTSAM, its covariance carried over to first order, because \
the wheel has no factor for it; judged by our χ² its optimum is 0.5 % above ours on Victoria Park, 5e-5 on \
CityTrees10k. What it stands above that is the work of its thresholds: isam2-0.1-fine has a wildfire of 1e-5.
- g2o: `initialize_optimization` and Gauss-Newton with Eigen's sparse Cholesky (the wheel has no CHOLMOD) until the \
gain is below 1e-6, at steps that have a loop, or at every tenth pose; between them its only answer is composed.
- χ² is Σ rᵀΩr of g2o's residuals, by one evaluator for all, at up to 100 steps spread by the golden section, against \
the optimum at the same step; where that is below 1, an excess is not a share; spikes are samples more than 1 % above \
the optimum.
- MB: the largest resident size of the process, in brackets what it had before the first step."""
