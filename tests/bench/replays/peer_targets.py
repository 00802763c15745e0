"""What `bench peers` must show: time, long steps and quality on every data set, and what holds for all of them."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from .chi2 import ratio
from .contestants import ENTRIES, PEER
from .targets import MET, MISSED, NOT_MEASURED, Rows, Verdict

OURS = "auto"


@dataclass(frozen=True, slots=True)
class Bar:
    """times: iSAM2's time over ours at least; p99_ms: of our steps, an estimate of all variables included, at most."""

    times: float
    p99_ms: float


BARS = {
    "intel": Bar(5, 1.0),
    "killian": Bar(5, 1.0),
    "killian_freiburg": Bar(5, 1.0),
    "manhattan3500": Bar(6, 1.5),
    "citytrees10000": Bar(10, 2.0),
    "victoria_park": Bar(8, 3.0),
    "city10000": Bar(12, 4.0),
    "w10000": Bar(10, 8.0),
    "w10000_toro": Bar(10, 8.0),
    "sphere2500": Bar(5, 9.0),
    "parking_garage": Bar(5, 5.0),
}
QUALITY = {"median": 1.0002, "p99": 1.002, "max": 1.01}
QUALITY_WORDS = ", ".join(f"{name} {bar:g}" for name, bar in QUALITY.items())
MEAN_TIMES, MEAN_TIMES_SKIP10 = 10.0, 6.0  # over iSAM2 that relinearizes at every update, and at every tenth
TIMES_SKIP10 = 3.0  # at least, on each data set
SETTLED = 1e-6
SAME = 1e-6  # two ratios that differ by less are the same
SOLVED = 1e-12
GROWN_P50, GROWN_P99, GROWN_MEMORY = 1.5, 4.0, 1.2
LENT = 0.9  # of the time that a long step takes alone
GROWN_FROM, GROWN_TO = 1_000, 100_000
OVERHEAD_US, ODOMETRY_US, START_S, COLD_S = 15.0, 10.0, 1.5, 60.0


def judge(rows: Sequence[dict[str, Any]], ends: dict[str, float], judged: str = OURS) -> list[Verdict]:
    """The data sets in `ends`, which maps them to the reference optimum; what is not a whole data set has no bars.

    judged: the contestant that is to show it.
    """
    table: Rows = {(row["dataset"], row["name"]): row for row in rows}
    found: list[Verdict] = []
    for dataset, optimum in ends.items():
        ours = table.get((dataset, judged))
        if dataset not in BARS or ours is None:
            continue
        if ours["status"] != "done":
            found.append(Verdict(f"{dataset}: {judged} goes through without an exception", ours["note"], MISSED))
            continue
        found += [
            _time(dataset, ours, table.get((dataset, ours["ratio_against"]))),
            _time_of_skipping(dataset, ours),
            _p99(dataset, ours),
            _quality(dataset, ours),
            _no_worse(dataset, ours, table.get((dataset, PEER))),
            _settled(dataset, ours, optimum),
        ]
    rows = [table[d, judged] for d in ends if d in BARS and (d, judged) in table]
    means = [_mean(rows, "ratio_to_isam2", "iSAM2", MEAN_TIMES)]
    means += [_mean(rows, "ratio_to_skip10", "iSAM2 with skip 10", MEAN_TIMES_SKIP10)]
    return [*found, *means] if found else []


def judge_growth(found: dict[str, Any] | None) -> list[Verdict]:
    """The drive of 100,000 poses."""
    words = (
        f"{GROWN_FROM} to {GROWN_TO} poses: median step time grows by less than {GROWN_P50} x",
        f"{GROWN_FROM} to {GROWN_TO} poses: p99 step time grows by less than {GROWN_P99} x",
        f"memory per pose is constant within {GROWN_MEMORY - 1:.0%}",
        f"memory per nonzero of R grows by no more than {GROWN_MEMORY - 1:.0%}",
    )
    if found is None:
        return []
    if found["status"] == "failed":
        return [Verdict(what, found["reason"], MISSED) for what in words]
    starts = {window["from"]: window for window in found["windows"]}
    if GROWN_FROM not in starts or found["poses"] < GROWN_TO:
        return [Verdict(what, f"{found['poses']} poses", NOT_MEASURED) for what in words]
    first, last = starts[GROWN_FROM], found["windows"][-1]
    verdicts = []
    for what, name, limit in zip(words, ("p50", "p99"), (GROWN_P50, GROWN_P99), strict=False):
        grown = last[name] / first[name]
        verdicts.append(verdict(what, f"{grown:.2f} x ({first[name]:.3f} to {last[name]:.3f} ms)", grown < limit))
    each = bytes_per_pose(found["memory"])
    kilobytes = ", ".join(f"{poses}: {size / 1024:.2f} KiB" for poses, size in each)
    spread = max(size for _, size in each) / min(size for _, size in each)
    verdicts.append(verdict(words[2], f"{spread:.2f} x ({kilobytes})", spread <= GROWN_MEMORY))
    nonzeros = {row["poses"]: row["nonzeros"] for row in found["memory"]}
    each = [(poses, size * poses / nonzeros[poses]) for poses, size in each if nonzeros[poses]]
    if not each:
        return [*verdicts, Verdict(words[3], "R is not kept", NOT_MEASURED)]
    sizes = ", ".join(f"{poses}: {size:.1f} bytes" for poses, size in each)
    grown = max(size for _, size in each) / each[0][1]
    return [*verdicts, verdict(words[3], f"{grown:.2f} x ({sizes})", grown <= GROWN_MEMORY)]


def judge_cores(found: dict[str, Any] | None, poses: int) -> list[Verdict]:
    """A second core for the longest steps of a drive of this number of poses."""
    if found is None:
        return []
    words = (
        f"with a second core the longest steps of {poses} poses take less than {LENT:g} of the time by the clock",
        "the estimate is the same to the bit, with a second core and without",
    )
    if found["status"] == "failed":
        return [Verdict(what, found["reason"], NOT_MEASURED) for what in words]
    longest = found["longest"]
    share = longest["together"] / longest["alone"]
    seen = f"{share:.2f} ({longest['alone']:.1f} to {longest['together']:.1f} ms, the mean of {longest['steps']})"
    return [
        verdict(words[0], seen, share < LENT)
        if found["poses"] >= poses
        else Verdict(words[0], f"{seen}, of {found['poses']} poses", NOT_MEASURED),
        verdict(words[1], "yes" if found["same_bits"] else "no", found["same_bits"]),
    ]


def judge_passes(found: dict[str, dict[str, Any]]) -> list[Verdict]:
    """Full passes by data set."""
    verdicts = []
    for dataset, passed in found.items():
        what = f"{dataset}: a full batch pass is no slower than CHOLMOD's analyse + factor + solve"
        if "ms" not in passed:
            verdicts.append(Verdict(what, passed["reason"], MISSED))
            continue
        ours, theirs = passed["ms"]["ours"]["total"], passed["ms"][passed["best"]]["total"]
        seen = f"{ours:.2f} ms against {theirs:.2f} ms ({passed['best']}), {passed['ratio']:.2f} x"
        if not any("openblas" in path for path in passed["blas"]):
            verdicts.append(Verdict(what, f"{seen}, but with {', '.join(passed['blas'])}", NOT_MEASURED))
        elif passed["residual"]["ours"] > SOLVED:
            verdicts.append(Verdict(what, f"its solution has a residual of {passed['residual']['ours']:.1e}", MISSED))
        else:
            verdicts.append(verdict(what, seen, passed["ratio"] >= 1.0))
    return verdicts


def judge_overhead(found: dict[str, Any] | None) -> list[Verdict]:
    """Python around the compiled calls, and starting."""
    if found is None:
        return []
    step, start, cold = found["step"], found["start"], found["cold"]
    by = f"by {step['by']}"
    verdicts = [
        verdict(
            f"Python adds less than {OVERHEAD_US:g} µs to a step",
            f"{step['all']['outside_us']:.1f} µs, median of {step['all']['steps']} steps, {by}",
            step["all"]["outside_us"] < OVERHEAD_US,
        ),
        verdict(
            f"a step of odometry alone takes less than {ODOMETRY_US:g} µs inside the compiled call",
            f"{step['odometry']['inside_us']:.1f} µs, median of {step['odometry']['steps']} steps, {by}",
            step["odometry"]["inside_us"] < ODOMETRY_US,
        ),
        verdict(
            f"a new process has made its first step after less than {START_S:g} s, kernels on disk",
            f"{start['cpu_s']:.2f} s of CPU, {start['wall_s']:.2f} s by the clock",
            start["cpu_s"] < START_S and start["compiled_s"] == 0.0,
        ),
    ]
    what = f"compiling everything takes less than {COLD_S:g} s and is announced"
    if cold is None:
        return [*verdicts, Verdict(what, "", NOT_MEASURED)]
    seen = f"{cold['cpu_s']:.1f} s of CPU, {len(cold['announced'])} lines said so"
    return [*verdicts, verdict(what, seen, cold["cpu_s"] < COLD_S and len(cold["announced"]) > 3)]


def bytes_per_pose(memory: Iterable[dict[str, int]]) -> list[tuple[int, float]]:
    """(poses, bytes a pose): what the solver says it uses, from 1,000 poses on; where it says nothing, resident
    memory, whose pages are too coarse to judge before 10,000."""
    sizes = [(each["poses"], each["used"] / each["poses"]) for each in memory if "used" in each]
    if sizes:
        return [each for each in sizes if each[0] >= GROWN_FROM]
    return [(each["poses"], each["resident"] / each["poses"]) for each in memory if each["poses"] >= 10 * GROWN_FROM]


def times_faster(row: dict[str, Any], ratio: str = "ratio_to_isam2") -> float | None:
    """iSAM2's time over the row's."""
    return 1 / row[ratio] if row[ratio] else None


def _time(dataset: str, ours: dict[str, Any], peer: dict[str, Any] | None) -> Verdict:
    bar = BARS[dataset]
    what = f"{dataset}: at most 1/{bar.times:g} of the time of iSAM2's update() (0.1, skip 1), our estimates included"
    times = times_faster(ours)
    if peer is None or times is None:
        return Verdict(what, "" if peer is None else peer["note"], NOT_MEASURED)
    seen = f"1/{times:.2f} ({ours['cpu_s']:.3f} s; iSAM2 {peer['cpu_s']:.3f} s, reading estimates {_s(peer['read_s'])})"
    if peer["name"] != PEER:
        seen += f"; {ENTRIES[peer['name']].label}, because without that it gave up"
    if peer["status"] != "done":
        seen += f"; up to step {ours['ratio_steps']}, where iSAM2 stopped: {peer['note']}"
    return verdict(what, seen, times >= bar.times)


def _time_of_skipping(dataset: str, ours: dict[str, Any]) -> Verdict:
    what = f"{dataset}: at most 1/{TIMES_SKIP10:g} of the time of iSAM2's update() (0.1, skip 10)"
    times = times_faster(ours, "ratio_to_skip10")
    if times is None:
        return Verdict(what, "", NOT_MEASURED)
    return verdict(what, f"1/{times:.2f}", times >= TIMES_SKIP10)


def _p99(dataset: str, ours: dict[str, Any]) -> Verdict:
    seen, bar = ours["step_ms"]["p99"], BARS[dataset].p99_ms
    return verdict(f"{dataset}: p99 of the steps at most {bar:g} ms", f"{seen:.3f} ms", seen <= bar)


def _quality(dataset: str, ours: dict[str, Any]) -> Verdict:
    what, found = f"{dataset}: χ²/χ²_batch at most {QUALITY_WORDS}", ours["chi2_ratio"]
    if not found:
        return Verdict(what, ours["note"], MISSED)
    seen = ", ".join(f"{name} {found[name]:.6f}" for name in QUALITY)
    is_met = all(found[name] <= bar for name, bar in QUALITY.items())
    return verdict(what, seen, is_met)


def _no_worse(dataset: str, ours: dict[str, Any], peer: dict[str, Any] | None) -> Verdict:
    what = f"{dataset}: χ²/χ²_batch no worse than iSAM2's, {', '.join(QUALITY)}"
    if peer is None or not peer["chi2_ratio"] or not ours["chi2_ratio_common"]:
        return Verdict(what, "" if peer is None else peer["note"], NOT_MEASURED)
    mine, theirs = ours["chi2_ratio_common"], peer["chi2_ratio"]
    seen = ", ".join(f"{name} {mine[name]:.6f} against {theirs[name]:.6f}" for name in QUALITY)
    return verdict(what, seen, all(mine[name] <= theirs[name] + SAME for name in QUALITY))


def _settled(dataset: str, ours: dict[str, Any], optimum: float) -> Verdict:
    what = f"{dataset}: settled at the end, χ² is within {SETTLED:g} of the reference optimum"
    if ours["chi2_settled"] is None:
        return Verdict(what, "", NOT_MEASURED)
    off = ratio(ours["chi2_settled"], optimum) - 1
    return verdict(what, f"{ours['chi2_settled']:.10g} against {optimum:.10g} ({off:+.1e})", abs(off) <= SETTLED)


def _mean(rows: Iterable[dict[str, Any]], ratio: str, peer: str, least: float) -> Verdict:
    what = f"geometric mean of {peer}'s time over ours on all {len(BARS)} data sets at least {least:g}"
    known = [times for row in rows if (times := times_faster(row, ratio))]
    if not known:
        return Verdict(what, "", NOT_MEASURED)
    mean = math.exp(sum(math.log(each) for each in known) / len(known))
    seen = f"{mean:.2f} over {len(known)} of {len(BARS)}"
    return verdict(what, seen, mean >= least) if len(known) == len(BARS) else Verdict(what, seen, NOT_MEASURED)


def _s(seconds: float | None) -> str:
    return "not measured" if seconds is None else f"{seconds:.3f} s"


def verdict(what: str, seen: str, is_met: bool) -> Verdict:
    """Met or missed."""
    return Verdict(what, seen, MET if is_met else MISSED)
