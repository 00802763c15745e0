"""The evaluation of the 2013 paper with our solver beside GTSAM's iSAM2 and g2o, on the six data sets of the paper.

    python tests/bench/paper.py [--quick] [--only NAME,...] [--json [FILE]] [--repetitions N] [--fresh] [...]

Every run is a process of its own on one core and is kept in the output folder (out/bench/paper): a second call goes on
where the first was stopped and measures only what is new or changed.  All of it takes hours, nearly all of them on 10k;
--quick takes two minutes.  Without data sets (FACTORBUS_DATASETS) it replays simulated worlds.

NAME is a data set (intel, w10000, ...) or a solver (inc-l, all-batch, inc-l-b10, inc-l-b100, auto, isam2-0.1,
isam2-0.01, isam2-0.1-qr, isam2-0.01-qr, isam2-0.1-fine, g2o-b1, g2o-b10); auto and isam2-0.1-fine run only when asked
for.  The exit code is 1 when a target is missed.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.replays import problems, runner, summary, table, targets
from bench.replays.bars import bars
from bench.replays.command import add_options, hand_out, positive
from bench.replays.contestants import ENTRIES, QUICK, TABLE_1, Entry
from bench.replays.problems import Problem
from bench.replays.samples import Sampling

_PIXELS = 360  # of the pictures of R
_DRAWN = {"intel", "victoria_park", "city_trees"}  # the systems of Figures 1 and 2: one of poses, one with landmarks
_FIGURE_5 = ("w10000", "manhattan3500", "manhattan")


def main() -> None:
    """Measure what is missing, print, draw; exit 1 when a target is missed."""
    options = _options()
    chosen, note = problems.choose(options.quick)
    chosen, entries, absent = _selection(chosen, options.only, QUICK if options.quick else TABLE_1)
    sampling = Sampling(options.samples)
    settings = runner.Settings(options.out, runner.pick_core(), sampling, options.limit_s, options.fresh)
    try:
        measured = measure(settings, chosen, entries, options.repetitions)
    except runner.Crashed as problem:
        sys.exit(f"bench paper: optima or fill-in could not be computed: {problem}")
    except KeyboardInterrupt:
        sys.exit(f"bench paper: stopped; what is finished is in {options.out}, and the same call goes on from there")
    document = conclude(measured, chosen, entries, [note, *absent])
    if not options.no_figures:
        document["figures"] = [str(path) for path in draw(options.out, measured, chosen, document.pop("optima"))]
    document.pop("optima", None)
    verdicts = document.pop("verdicts")
    text = table.report(document["rows"], document["fill"], verdicts, document["notes"], document["machine"])
    hand_out("paper", document, text, options)
    if any(target["verdict"] == targets.MISSED for target in document["targets"]):
        sys.exit(1)


def measure(
    settings: runner.Settings, chosen: Sequence[Problem], entries: Sequence[Entry], repetitions: int
) -> dict[str, dict[str, Any]]:
    """Per problem its "runs" by contestant, its "reference" and its "fill".

    The solvers take turns: all of them once on a data set before any of them a second time.
    """
    found: dict[str, dict[str, Any]] = {p.key: {"runs": {e.name: [] for e in entries}} for p in chosen}
    total = len(chosen) * (repetitions * len(entries) + 2)
    with bars(total) as (begin, progress):
        for problem in chosen:
            begin(f"{problem.key}: optima", problem.steps)
            found[problem.key]["reference"] = runner.run_reference(settings, problem, progress)
            begin(f"{problem.key}: fill-in", problem.steps)
            found[problem.key]["fill"] = runner.run_fill(settings, problem, _PIXELS, progress)
        for repetition in range(repetitions):
            for problem in chosen:
                for entry in entries:
                    begin(f"{problem.key}: {entry.name}", problem.steps)
                    run = runner.run_replay(settings, problem, entry, repetition, progress)
                    found[problem.key]["runs"][entry.name].append(run)
    return found


def conclude(
    measured: dict[str, dict[str, Any]], chosen: Sequence[Problem], entries: Sequence[Entry], notes: Sequence[str]
) -> dict[str, Any]:
    """Rows, fill-in, targets and notes."""
    rows, optima, said, ends = [], {}, [note for note in notes if note], {}
    for problem in chosen:
        found = measured[problem.key]
        firsts = [runs[0] for runs in found["runs"].values() if runs]
        batch, remarks = summary.best_known(problem, found["reference"], firsts)
        said += remarks
        optima[problem.key], ends[problem.key] = batch, summary.optimum_of(problem, batch)
        rows += [summary.row_of(problem, entry, found["runs"][entry.name], batch) for entry in entries]
    fills = {problem.key: {**measured[problem.key]["fill"]} for problem in chosen}
    verdicts = targets.judge(rows, ends, fills)
    return {
        "machine": runner.machine(),
        "notes": said,
        "rows": rows,
        "fill": fills,
        "targets": [{"what": v.what, "seen": v.seen, "verdict": v.verdict} for v in verdicts],
        "verdicts": verdicts,
        "optima": optima,
    }


def draw(
    folder: Path, measured: dict[str, dict[str, Any]], chosen: Sequence[Problem], optima: dict[str, dict[int, float]]
) -> list[Path]:
    """The figures, in `folder`."""
    from bench.replays import figures, fill_figures

    folder.mkdir(parents=True, exist_ok=True)
    drawn = [p for p in chosen if p.name in _DRAWN] or list(chosen[:1])
    systems = [(p.label, measured[p.key]["fill"], Path(measured[p.key]["fill"]["values"])) for p in drawn]
    paths = [folder / f"figure_{k}.png" for k in range(1, 6)]
    fill_figures.constraint_figure(paths[0], systems)
    fill_figures.elements_figure(paths[1], systems)
    figures.maps_figure(paths[2], [(p, Path(measured[p.key]["reference"]["values"])) for p in chosen])
    runs = {p.key: [each[0] for each in measured[p.key]["runs"].values() if each] for p in chosen}
    figures.time_figure(paths[3], runs, {p.key: p.label for p in chosen}, "Fig. 4   ")
    along = min(chosen, key=lambda p: _FIGURE_5.index(p.name) if p.name in _FIGURE_5 else len(_FIGURE_5))
    figures.chi2_figure(paths[4], along.label, runs[along.key], optima[along.key])
    return paths


def _selection(
    chosen: Sequence[Problem], only: str, usual: Sequence[str]
) -> tuple[list[Problem], list[Entry], list[str]]:
    """The problems and contestants asked for, and a line for each that cannot run here."""
    words = [word for word in only.split(",") if word]
    names = [word for word in words if word in ENTRIES]
    wanted = [p for p in chosen if not words or {p.name, p.key} & set(words) or len(names) == len(words)]
    unknown = [w for w in words if w not in ENTRIES and not any(w in (p.name, p.key) for p in chosen)]
    if unknown:
        sys.exit(
            f"--only {','.join(unknown)}: neither a data set that is here ({', '.join(p.name for p in chosen)}) nor a "
            f"solver ({', '.join(ENTRIES)})"
        )
    entries = [ENTRIES[name] for name in (names or usual)]
    absent = [f"Not measured: {entry.label} ({entry.missing()})." for entry in entries if entry.missing()]
    return wanted, [entry for entry in entries if not entry.missing()], absent


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_options(parser, "paper", repetitions=1)
    parser.add_argument("--samples", type=positive, default=100, help="steps at which χ² is held against the optimum")
    return parser.parse_args()


if __name__ == "__main__":
    main()
