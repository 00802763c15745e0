"""The page of results in the docs, out of a document of `bench peers`: README's table is lines of it."""

import shlex
from collections.abc import Sequence
from typing import Any

from .contestants import PEER, SKIPPING, STAND_INS
from .table import line, number
from .targets import MET

HEAD = (
    "", "steps", "factorbus", "iSAM2, skip 1", "skip 10", "p50, p99 of our steps", "χ²/batch, worst: ours", "skip 1",
    "skip 10", "over the bus",
)  # fmt: skip
_ALIGNED = ("---", *["---:"] * (len(HEAD) - 1))


def page(document: dict[str, Any], arguments: Sequence[str]) -> str:
    """arguments: of the command that measured it; where its files went is left out."""
    machine, rows = document["machine"], document["rows"]
    titles = {row["dataset"]: row["title"] for row in rows}
    versions = {name: each for row in rows for name, each in row["versions"].items()}
    worlds = [dataset for dataset, title in titles.items() if "simulated" in title]
    data = [dataset for dataset in titles if dataset not in worlds]
    dates = sorted(row["measured_at"][:10] for row in rows if row["measured_at"])
    command = " ".join(["factorbus bench peers", shlex.join(_measuring(arguments))]).strip()
    parts = [
        "# Results",
        f"What `{command}` found, on {' and '.join(dict.fromkeys((dates[0], dates[-1])))}, on one core: "
        f"{machine['cpu']} ({machine['cores']} cores), with "
        f"{', '.join(f'{name} {each}' for name, each in sorted(versions.items()))}.",
        _WORDS,
    ]
    for words, datasets in (("Public data sets", data), ("Simulated worlds", worlds)):
        if datasets:
            lines = [line(HEAD), line(_ALIGNED), *(row_of(document, dataset) for dataset in datasets)]
            parts += [f"## {words}", "\n".join(lines)]
    parts += ["## What was to be shown", _targets(document["targets"])]
    return "\n\n".join([*parts, *(f"> {note}" for note in document["notes"])]) + "\n"


def _measuring(arguments: Sequence[str]) -> list[str]:
    kept, skipped = list[str](), False
    for word in arguments:
        if not skipped and word not in ("--out", "--page", "--no-figures"):
            kept.append(word)
        skipped = word in ("--out", "--page") and not skipped
    return kept


def row_of(document: dict[str, Any], dataset: str) -> str:
    """One line of the table."""
    rows = {row["name"]: row for row in document["rows"] if row["dataset"] == dataset}
    ours, waited = rows[document["judged"]], document["over_bus"].get(dataset, {}).get("insert_ms")
    peers = [_of(rows, name) for name in (PEER, SKIPPING)]
    step = ours["step_ms"]
    cells = [dataset, str(ours["steps"]), _seconds(ours)]
    cells += [_seconds(row) + ("" if times is None else f" ({times:.1f} ×)") for row, times in peers]
    cells.append(f"{step['p50']:.2f}, {step['p99']:.1f} ms")
    cells += [_worst(row) for row in (ours, *(row for row, _ in peers))]
    cells.append(f"{waited['p50']:.1f}, {waited['p99']:.1f} ms" if waited else "")
    return line(cells)


def _of(rows: dict[str, dict[str, Any]], name: str) -> tuple[dict[str, Any] | None, float | None]:
    """(the row of iSAM2, or of its stand-in where that gave up; its time over ours)."""
    row = rows.get(name)
    if row is None or (row["status"] != "done" and STAND_INS[name] in rows):
        row = rows.get(STAND_INS[name], row)
    ours = next(each for each in rows.values() if each["name"] not in (PEER, SKIPPING, *STAND_INS.values()))
    ratio = ours["ratio_to_isam2" if name == PEER else "ratio_to_skip10"]
    return row, 1 / ratio if ratio else None


def _seconds(row: dict[str, Any] | None) -> str:
    if row is None or row["cpu_s"] is None:
        return ""
    return f"{row['cpu_s']:.2g} s" if row["cpu_s"] < 10 else f"{row['cpu_s']:.0f} s"


def _worst(row: dict[str, Any] | None) -> str:
    return "" if row is None else number(row["chi2_ratio"].get("max"), "{:.4f}")


def _targets(targets: Sequence[dict[str, str]]) -> str:
    """How many are met, those that are not, and what those of all sets together came to."""
    rest = [each for each in targets if each["verdict"] != MET]
    means = [each for each in targets if each not in rest and "geometric mean" in each["what"]]
    counted = f"{len(targets) - len(rest)} of {len(targets)} targets are met. The others:"
    parts = ["\n".join([counted, "", *map(_line, rest)]) if rest else f"All {len(targets)} targets are met."]
    if means:
        parts.append("\n".join(["Of all sets together:", "", *map(_line, means)]))
    return "\n\n".join(parts)


def _line(target: dict[str, str]) -> str:
    return f"- {target['verdict']}: {target['what']}: {target['seen']}".rstrip(": ")


_WORDS = """\
Every data set is driven in pose by pose. CPU seconds of the solvers alone: ours with all estimates read after every
step, GTSAM's iSAM2 (relinearize threshold 0.1, its `relinearizeSkip` 1, and 10 as it ships) with `update()` alone, and
in brackets how many times ours that is. χ²/batch: χ² of the estimate over that of the optimum found from scratch, the
worst of all steps. Over the bus: how long a robot waits from an insert until it has the estimate with it, by the clock,
p50 and p99, the service in a process of its own. Where iSAM2 gives up, its columns are those with the information of
rotations as GTSAM's own reader takes it from the file. Of each world the first line has a seed that was looked at while
constants were chosen, the second one that was drawn for this run."""
