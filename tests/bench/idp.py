"""Inverse-depth features: the tables and figures of Idris and others (2011) with our own column, seconds, and workers.

    python tests/bench/idp.py [--json] [--figures FOLDER] [--no-workers]

Multiplications are counted by the code that runs.  Seconds are the best of several runs in this process, on one core.
The last parts start a service and workers, one of them on the real tracks of `idp_euroc.py` where these are here; on a
machine with two cores leave it alone meanwhile.  The exit code is 1 when a target is missed.
"""

import argparse
import json
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one core for everybody
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench import idp_bus, idp_euroc, idp_map, idp_paper, idp_times

_SIZES = ((3, 0), (10, 0), (100, 0), (1000, 0), (10, 100))
_MANY = 10_000
_METHODS = ("classical", "classical-blas", "independent", "minimal", "minimal-half", "factored")


def main() -> None:
    """Measure, print, draw; exit 1 when a target is missed."""
    options = _options()
    found = run(options.workers)
    if options.figures:
        options.figures.mkdir(parents=True, exist_ok=True)
        found["figures"] = [str(path) for path in idp_paper.draw(options.figures, found["paper"])]
    print(json.dumps(found, indent=1) if options.json else report(found))
    if not all(target["met"] for target in found["targets"]):
        sys.exit(1)


def run(workers: bool) -> dict[str, Any]:
    """Everything, as a document."""
    rows = [row for features, existing in _SIZES for row in idp_times.rows(features, existing)]
    rows += idp_times.factored(_MANY)
    found = {"paper": idp_paper.tables(), "rows": rows, "write_s": idp_times.written(1000)}
    if workers:
        found["bus"] = bus = idp_bus.measure()
        for count, rate in ((0, "in_place"), (1, "one"), (2, "two")):
            seconds = 1.0 / bus["questions_per_s"][rate]
            row = {
                "features": bus["features"],
                "existing": 0,
                "method": "minimal over the bus",
                "multiplications": None,
            }
            rows.append(row | {"seconds": seconds, "workers": count, "extrapolated": False})
        found["maps"] = idp_map.measure()
        if folder := idp_euroc.try_find_tracks():
            with TemporaryDirectory() as scratch:
                found["euroc"] = idp_euroc.run(folder, 1, Path(scratch))
    found["targets"] = targets(found)
    return found


def targets(found: dict[str, Any]) -> list[dict[str, Any]]:
    """What is wanted and what came out."""
    three = next(row for row in found["paper"]["figure_10"] if row["features"] == 3)
    seconds = {(row["method"], row["features"], row["existing"]): row for row in found["rows"]}

    def ratio(slow: str, fast: str, n: int, what: str = "seconds") -> float:
        return seconds[slow, n, 0][what] / seconds[fast, n, 0][what]

    fewer = ratio("classical", "independent", 100, "multiplications")
    many = seconds["factored", _MANY, 0]["seconds"]
    pixels = seconds["factored-from-pixels", _MANY, 0]["seconds"]
    whole = seconds["minimal", 1000, 0]["seconds"]
    wanted = [
        ("multiplications for 3 features, classical", three["classical"], "=", idp_paper.STATED["classical"]),
        ("multiplications for 3 features, independent", three["independent"], "=", idp_paper.STATED["independent"]),
        ("independent is faster than classical, n = 100", ratio("classical", "independent", 100), ">=", 100.0),
        ("... by more than it multiplies less", ratio("classical", "independent", 100), ">=", round(fewer, 1)),
        ("... and than classical by BLAS", ratio("classical-blas", "independent", 100), ">=", 100.0),
        ("minimal is faster than independent, n = 1000", ratio("independent", "minimal", 1000), ">=", 2.0),
        ("10,000 features from pixels to factors, ms", pixels * 1e3, "<=", 10.0),
        ("the same, factors alone, share of the whole matrix of n = 1000", many / whole, "<=", 1 / 50),
    ]
    if "bus" in found:
        wanted.append(("two workers do more than one", found["bus"]["ratio"], ">=", found["bus"]["goal"]))
    for row in found.get("maps", ()):
        name = f"a map whose features {'become' if row['points'] else 'are not'} points"
        wanted.append((f"{name}: positions within 3σ", row["nees_position"]["within"], ">=", 0.99))
        wanted.append((f"{name}: inverse depths within 3σ", row["inverse_depth"]["within"], ">=", 0.99))
    return [
        {"target": name, "seen": seen, "wanted": f"{sign} {limit:g}", "met": _meets(seen, sign, limit)}
        for name, seen, sign, limit in wanted
    ]


def report(found: dict[str, Any]) -> str:
    """Tables for a person."""
    paper = found["paper"]
    lines = ["Table 1: sizes of the matrices, classical", ""]
    lines += [f"{'iteration':>10}{'J':>10}{'P':>10}{'Jᵀ':>10}{'multiplications':>18}"]
    for row in paper["table_1"]:
        shapes = [f"{a}×{b}" for a, b in (row["J"], row["P"], row["Jt"])]
        lines.append(f"{row['iteration']:>10}" + "".join(f"{s:>10}" for s in shapes) + f"{row['multiplications']:>18,}")
    lines += [f"{'sum':>40}{sum(paper['figure_5']):>18,}", "", "Table 2: independent, three features", ""]
    lines += ["".join(f"{cell:>14}" for cell in line) for line in paper["table_2"]]
    lines += [f"{'sum':>40}{sum(paper['figure_8'].values()):>18,}", "", "Figure 10: multiplications", ""]
    names = ("features", "classical", "independent", "minimal", "minimal-half", "factored")
    lines += ["".join(f"{name:>16}" for name in names)]
    lines += ["".join(f"{row[name]:>16,}" for name in names) for row in paper["figure_10"]]
    lines += ["", "Seconds, one process", "", *_times(found["rows"])]
    if "bus" in found:
        lines += ["", *_bus(found["bus"])]
    if "maps" in found:
        lines += ["", idp_map.report(found["maps"])]
    if "euroc" in found:
        lines += ["", idp_euroc.report(found["euroc"])]
    lines += ["", "Targets", ""]
    for target in found["targets"]:
        verdict = "met" if target["met"] else "MISSED"
        lines.append(f"  {target['target']:<64}{target['seen']:>12,.4g}  {target['wanted']:<12}{verdict}")
    return "\n".join([*lines, *(f"  drawn: {path}" for path in found.get("figures", ()))])


def _times(rows: list[dict[str, Any]]) -> list[str]:
    lines = [f"{'features':>9}{'existing':>9}  {'method':<22}{'multiplications':>20}{'ms':>16}{'workers':>9}"]
    for row in rows:
        count = f"{row['multiplications']:,}" if row["multiplications"] else ""
        ms = f"{row['seconds'] * 1e3:,.4g}" if row["seconds"] < 10 else f"{row['seconds'] * 1e3:,.0f}"
        mark = "~" if row["extrapolated"] else ""
        first = f"{row['features']:>9,}{row['existing']:>9}  {row['method']:<22}"
        lines.append(f"{first}{count:>20}{mark + ms:>16}{row['workers']:>9}")
    return [*lines, "  ~ a step measured, scaled by what all steps multiply"]


def _bus(bus: dict[str, Any]) -> list[str]:
    rates = {name: f"{rate:.1f}" for name, rate in bus["questions_per_s"].items()}
    ratios = " ".join(f"{ratio:.2f}" for ratio in bus["ratios"])
    return [
        f"Over the bus, {bus['features']} features a question, rows in shared memory",
        "",
        f"  questions/s: {rates['in_place']} in place, {rates['one']} with one worker, {rates['two']} with two",
        f"  two against one, in turns: {ratios}; median {bus['ratio']:.2f}",
        f"  the way to a worker takes {bus['way_ms']:.2f} ms and {bus['byte_ns']:.2f} ns a byte that travels back",
        f"  an answer takes {bus['overhead_ms']:.2f} ms beyond the {bus['work_ms']:.1f} ms of work of the slowest",
    ]


def _meets(seen: float, sign: str, limit: float) -> bool:
    return {"=": seen == limit, ">=": seen >= limit, "<=": seen <= limit}[sign]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--json", action="store_true", help="one document and nothing else")
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="draw Figures 5, 8 and 10 there")
    parser.add_argument("--no-workers", dest="workers", action="store_false", help="leave out what starts processes")
    return parser.parse_args()


if __name__ == "__main__":
    main()
