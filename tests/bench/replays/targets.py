"""What the rows must show, each as met, missed or not measured."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from .chi2 import ratio
from .summary import SPIKE

MET, MISSED, NOT_MEASURED = "met", "MISSED", "not measured"
Rows = dict[tuple[str, str], dict[str, Any]]  # (data set, name of the contestant) -> row

FASTER_10K = 1.8  # all-batch over inc-l on 10k, the ratio of the paper's Table 1
NEAR_OPTIMUM = 1e-4
FILL = 1.05
FORCED = ("inc-l-b10", "inc-l-b100")
AGAINST_ISAM2 = ("manhattan3500", "intel", "killian", "citytrees10000")


@dataclass(frozen=True, slots=True)
class Verdict:
    """One check: what was wanted, what was seen."""

    what: str
    seen: str
    verdict: str


def judge(rows: Sequence[dict[str, Any]], optima: dict[str, float], fills: dict[str, dict[str, Any]]) -> list[Verdict]:
    """All checks that concern the data sets in `optima`; `fills` are those of `fill.orderings` by data set."""
    table: Rows = {(row["dataset"], row["name"]): row for row in rows}
    found = []
    for dataset, optimum in optima.items():
        found.append(_near_optimum(table, dataset, optimum))
        found.append(_faster(table, dataset))
        if dataset in AGAINST_ISAM2 or dataset.rsplit("-", 1)[0] in AGAINST_ISAM2:
            found.append(_beats_isam2(table, dataset))
        found += _no_spikes(table, dataset)
    return [*found, _forced_spike(table, optima)] + [_fill(dataset, fill) for dataset, fill in fills.items()]


def missed(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Those that were measured and not met."""
    return [verdict for verdict in verdicts if verdict.verdict == MISSED]


def _near_optimum(table: Rows, dataset: str, optimum: float) -> Verdict:
    what = f"{dataset}: inc-l ends within {NEAR_OPTIMUM:g} of the optimum {optimum:.9g}"
    row = table.get((dataset, "inc-l"))
    if row is None:
        return Verdict(what, "", NOT_MEASURED)
    if row["chi2_final"] is None:
        return Verdict(what, row["note"], MISSED)
    off = ratio(row["chi2_final"], optimum) - 1
    return _verdict(what, f"{row['chi2_final']:.9g} ({off:+.1e})", abs(off) <= NEAR_OPTIMUM)


def _faster(table: Rows, dataset: str) -> Verdict:
    wanted = FASTER_10K if dataset == "w10000" else 1.0
    what = f"{dataset}: all-batch takes {'at least' if wanted > 1 else 'more than'} {wanted:g} x the time of inc-l"
    ours, batch = _pair(table, dataset, "all-batch")
    if ours is None or batch is None:
        return Verdict(what, "", NOT_MEASURED)
    if ours["status"] != "done" or batch["status"] not in ("done", "limit"):
        return Verdict(what, ours["note"] if ours["status"] != "done" else batch["note"], MISSED)
    factor = batch["cpu_s"] / ours["cpu_s"]
    least = ">= " if batch["status"] == "limit" else ""
    seen = f"{least}{factor:.2f} x ({batch['cpu_s']:.2f} s, {ours['cpu_s']:.2f} s)"
    if least and factor < wanted:
        return Verdict(what, f"{seen}; all-batch reached its time limit", NOT_MEASURED)
    return _verdict(what, seen, factor >= wanted if wanted > 1 else factor > 1)


def _beats_isam2(table: Rows, dataset: str) -> Verdict:
    what = f"{dataset}: inc-l takes less time than iSAM2 (0.1, skip 1, an estimate each step)"
    ours, peer = _pair(table, dataset, "isam2-0.1")
    if ours is None or peer is None:
        return Verdict(what, "", NOT_MEASURED)
    if ours["status"] != "done":
        return Verdict(what, ours["note"], MISSED)
    if peer["status"] != "done":
        return Verdict(what, f"iSAM2 did not finish: {peer['note']}", NOT_MEASURED)
    seen = f"{ours['cpu_s']:.2f} s against {peer['cpu_s']:.2f} s ({peer['cpu_s'] / ours['cpu_s']:.2f} x)"
    return _verdict(what, seen, ours["cpu_s"] < peer["cpu_s"])


def _no_spikes(table: Rows, dataset: str) -> list[Verdict]:
    """Inc-L has none; and where forced batches leave the optimum in between, it is nearer."""
    none = f"{dataset}: inc-l is never more than {SPIKE:g} x above the optimum at the samples"
    nearer = f"{dataset}: at its worst inc-l is no further from the optimum than b10 and b100"
    qualities = {}
    for name in ("inc-l", *FORCED, "isam2-0.1"):
        row = table.get((dataset, name))
        if row is not None and row["chi2_ratio"]:
            qualities[name] = row["chi2_ratio"]
    if "inc-l" not in qualities:
        return [Verdict(none, "", NOT_MEASURED), Verdict(nearer, "", NOT_MEASURED)]
    ours = qualities["inc-l"]
    others = [f"{name} {q['max']:.4f} ({q['spikes']} spikes)" for name, q in qualities.items() if name != "inc-l"]
    seen = f"worst {ours['max']:.6f}" + (f"; beside it {', '.join(others)}" if others else "")
    forced = [qualities[name]["max"] for name in FORCED if name in qualities]
    found = [_verdict(none, seen, ours["spikes"] == 0)]
    if len(forced) < len(FORCED):
        return [*found, Verdict(nearer, "", NOT_MEASURED)]
    return [*found, _verdict(nearer, seen, ours["max"] <= min(forced) + NEAR_OPTIMUM)]


def _forced_spike(table: Rows, datasets: Iterable[str]) -> Verdict:
    """The relation of the paper's Fig. 5 needs spikes to be absent in Inc-L and present in the others."""
    what = f"b10 and b100 rise more than {SPIKE:g} x above the optimum on some data set"
    seen, spiky = [], set()
    for name in FORCED:
        for dataset in datasets:
            row = table.get((dataset, name))
            if row is not None and row["chi2_ratio"] and row["chi2_ratio"]["spikes"]:
                spiky.add(name)
                seen.append(f"{name} on {dataset} {row['chi2_ratio']['max']:.4f}")
    if any(all((dataset, name) not in table for dataset in datasets) for name in FORCED):
        return Verdict(what, "", NOT_MEASURED)
    return _verdict(what, ", ".join(seen), spiky == set(FORCED))


def _fill(dataset: str, fill: dict[str, Any]) -> Verdict:
    what = f"{dataset}: R by our block ordering, constraint off, has at most {FILL:g} x the nonzeros of CHOLMOD's AMD"
    nnz = fill["nnz"]
    seen = (
        f"{fill['against_cholmod']:.4f} ({nnz['blocks']} against {nnz['cholmod_amd']}); "
        f"the constraint costs {100 * fill['price_of_constraint']:+.2f} %"
    )
    return _verdict(what, seen, fill["against_cholmod"] <= FILL)


def _pair(table: Rows, dataset: str, other: str) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    return table.get((dataset, "inc-l")), table.get((dataset, other))


def _verdict(what: str, seen: str, is_met: bool) -> Verdict:
    return Verdict(what, seen, MET if is_met else MISSED)
