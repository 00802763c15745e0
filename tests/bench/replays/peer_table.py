"""The report of `bench peers` as Markdown."""

from collections.abc import Sequence
from typing import Any

from .contestants import ENTRIES, PEER
from .peer_targets import BARS, OURS, bytes_per_pose, times_faster
from .table import details, line, number, verdict_list, when
from .targets import Verdict


def report(document: dict[str, Any], verdicts: Sequence[Verdict]) -> str:
    """The whole text."""
    rows, machine = document["rows"], document["machine"]
    parts = [
        "# Ahead of every peer",
        f"{machine['cpu']}, one core; Python {machine['python']}; CPU seconds of the solvers alone. {when(rows)}",
        *(f"> {note}" for note in document["notes"]),
    ]
    if rows:
        parts += ["## Replays", main_table(rows, document["judged"]), _LEGEND, "## Each data set"]
        for dataset in dict.fromkeys(row["dataset"] for row in rows):
            mine = [row for row in rows if row["dataset"] == dataset]
            parts += [f"### {mine[0]['title']}: {mine[0]['steps']} steps", details(mine)]
            parts += [f"- {row['name']}: {row['note']}" for row in mine if row["status"] != "done"]
    if document["over_bus"]:
        parts += ["## Over the bus", bus_table(document["over_bus"])]
    if document["growth"]:
        parts += ["## Growth", growth_table(document["growth"])]
    if document["cores"]:
        parts += ["## A second core", cores_table(document["cores"])]
    if document["full_pass"]:
        parts += ["## A full batch pass", pass_table(document["full_pass"]), _PASS_LEGEND]
    if document["overhead"]:
        parts += ["## Python and starting", overhead_list(document["overhead"])]
    if verdicts:
        parts += ["## What it must show", verdict_list(verdicts)]
    return "\n\n".join(parts) + "\n"


def main_table(rows: Sequence[dict[str, Any]], judged: str = OURS) -> str:
    """A line for each data set and contestant: time, against iSAM2, long steps, quality; bars for who is judged."""
    head = ["", "", "s", "read s", "iSAM2 / it", "bar", "skip 10 / it", "p50 ms", "p99", "bar", "max"]
    head += ["χ²/batch median", "p95", "p99", "max", "settled χ²"]
    lines = [line(head), line(["---", "---", *["---:"] * (len(head) - 2)])]
    for row in rows:
        bar = BARS.get(row["dataset"]) if row["name"] == judged else None
        step, quality, times = row["step_ms"], row["chi2_ratio"], times_faster(row)
        factor = number(times, "{:.2f}") + ("" if row["ratio_steps"] == row["steps"] or not times else "*")
        cells = [row["title"], ENTRIES[row["name"]].label + ("" if row["status"] == "done" else f" ({row['status']})")]
        cells += [number(row["cpu_s"], "{:.3f}"), number(row["read_s"], "{:.3f}")]
        cells += [factor, number(bar and bar.times, "{:g}"), number(times_faster(row, "ratio_to_skip10"), "{:.2f}")]
        cells.append(number(step.get("p50"), "{:.3f}"))
        cells += [
            number(step.get("p99"), "{:.3f}"),
            number(bar and bar.p99_ms, "{:g}"),
            number(step.get("max"), "{:.2f}"),
        ]
        cells += [number(quality.get(name), "{:.6f}") for name in ("median", "p95", "p99", "max")]
        cells.append(number(row["chi2_settled"], "{:.9g}"))
        lines.append(line(cells))
    return "\n".join(lines)


def bus_table(found: dict[str, dict[str, Any]]) -> str:
    """From an insert to the estimate with it, by data set."""
    names = ("p50", "p95", "p99", "max")
    lines = [line(["insert to estimate, ms", "steps", *names]), line(["---", *["---:"] * (1 + len(names))])]
    for dataset, seen in found.items():
        if "insert_ms" in seen:
            cells = [str(seen["steps"]), *(f"{seen['insert_ms'][name]:.2f}" for name in names)]
        else:
            cells = [seen["reason"], *[""] * len(names)]
        lines.append(line([dataset, *cells]))
    return "\n".join(lines)


def growth_table(found: dict[str, Any]) -> str:
    """Windows of the long drive, and bytes per pose at their ends."""
    lines = [line(["poses", "p50 ms", "p95", "p99", "max", "mean"]), line(["---", *["---:"] * 5])]
    for window in found["windows"]:
        names = ("p50", "p95", "p99", "max", "mean")
        lines.append(line([f"{window['from']} to {window['to']}", *(f"{window[name]:.4f}" for name in names)]))
    sizes = ", ".join(f"{size / 1024:.2f} at {poses}" for poses, size in bytes_per_pose(found["memory"]))
    said = f"\n\n{found['factors']} factors, {found['cpu_s']:.1f} s in all."
    said += f" KiB a pose: {sizes}." if sizes else ""
    return "\n".join(lines) + said + (f" {found['reason']}" if found["reason"] else "")


def cores_table(found: dict[str, Any]) -> str:
    """Steps by the clock, on one core and with a worker thread."""
    if found["status"] == "failed":
        return found["reason"]
    names = ("p50", "p95", "p99", "max")
    lines = [line([f"{found['poses']} poses, ms", *names]), line(["---", *["---:"] * len(names)])]
    for name, words in (("alone", "one core"), ("together", "two cores")):
        lines.append(line([words, *(f"{found[name][each]:.4f}" for each in names)]))
    return "\n".join(lines)


def pass_table(found: dict[str, dict[str, Any]]) -> str:
    """Milliseconds by phase of both."""
    phases = ("linearize", "order", "symbolic", "numeric", "solve", "total")
    head = ["", "scalars", *phases, "CHOLMOD analyse", "numeric", "solve", "total", "CHOLMOD / ours", "by"]
    lines = [line(head), line(["---", *["---:"] * (len(head) - 2), "---"])]
    for dataset, passed in found.items():
        if "ms" not in passed:
            lines.append(line([dataset, passed["reason"], *[""] * (len(head) - 2)]))
            continue
        ours, theirs = passed["ms"]["ours"], passed["ms"][passed["best"]]
        cells = [dataset, str(passed["scalars"]), *(f"{ours[name]:.2f}" for name in phases)]
        cells += [f"{theirs[name]:.2f}" for name in ("analyse", "numeric", "solve", "total")]
        lines.append(line([*cells, f"{passed['ratio']:.2f}", passed["best"].removeprefix("cholmod ")]))
    blas = sorted({path for passed in found.values() for path in passed.get("blas", ())})
    return "\n".join(lines) + f"\n\nCHOLMOD's BLAS: {', '.join(blas)}."


def overhead_list(found: dict[str, Any]) -> str:
    """Microseconds of a step in Python and in compiled calls; seconds of a start."""
    step, start, cold = found["step"], found["start"], found["cold"]
    lines = [f"Microseconds of stage and step, medians; inside compiled calls by {step['by']}.", ""]
    lines += [line(["", "steps", "all", "inside", "Python"]), line(["---", *["---:"] * 4])]
    for name in ("all", "odometry"):
        row = step[name]
        lines.append(
            line([name, str(row["steps"]), *(f"{row[part]:.1f}" for part in ("total_us", "inside_us", "outside_us"))])
        )
    lines += ["", f"A process with one step: {start['cpu_s']:.2f} s of CPU, {start['wall_s']:.2f} s by the clock."]
    if cold:
        lines.append(f"Compiling everything: {cold['cpu_s']:.1f} s of CPU, {cold['wall_s']:.1f} s by the clock.")
    return "\n".join(lines)


_LEGEND = f"""\
Every solver gets the same steps, one a pose, and new variables start composed from its own estimate; times are medians.

- Ours: stage, step and an estimate of all variables after every step are all in the time.
- iSAM2 ({ENTRIES[PEER].label}; relinearizeSkip 1, Gauss-Newton, Cholesky, wildfire 1e-3): `update()` and nothing else \
is in the time. It takes in what a rehearsal with estimates has composed, so that no estimate asked for in between \
takes back-substitution off its clock; *read s* is calculateEstimate after every step of the rehearsal, on top.
- *iSAM2 / it*: how many times iSAM2's time; with a star up to the step where one of them stopped. *skip 10 / it*: of \
iSAM2 as it ships, which relinearizes at every tenth update. Where iSAM2 gives \
up, its time is that with the information of rotations as GTSAM's own reader takes it, four times of what it is for \
us: a better conditioned problem, with another χ².
- χ² is Σ rᵀΩr of g2o's residuals, by one evaluator for all, at every step (--chi2-every), against the optimum at the \
same step, in replays that are not timed; where an optimum is below 1, an excess is not a share. *settled χ²*: after \
iterating until converged, at the end."""

_PASS_LEGEND = """\
Thread CPU milliseconds at the optimum, medians of interleaved repetitions. Ours linearizes as well; CHOLMOD, through \
scikit-sparse, gets the matrix, and the fastest of its modes and orderings counts."""
