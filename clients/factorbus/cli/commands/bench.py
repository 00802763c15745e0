"""`factorbus bench`: the measurements of the repository, run from the command line."""

import json
import subprocess
import sys
from pathlib import Path

import click

from factorbus.cli.output.console import document, print_note
from factorbus.cli.output.exits import FAILED, OK, Stopped
from factorbus.cli.process.options import json_option

BENCHES = ("cholesky", "bus", "idp", "ros2", "journal")  # what `all` runs, some minutes
LONG = ("every-step", "paper", "peers", "fuzz", "soak", "mixed", "lifelong")  # hours (the last four: less than one)
ASKED = (
    "aligning",
    "ask",
    "batch",
    "budget",
    "closures",
    "digest",
    "calibration",
    "inertial",
    "large",
    "large",
    "own",
    "ranges",
    "sessions",
    "sizing",
)  # a minute or two; on request


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("name", type=click.Choice([*BENCHES, *ASKED, *LONG, "all"]))
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
@json_option
def command(name: str, options: tuple[str, ...], as_json: bool) -> int:
    """Measure NAME, each beside what it is held against; the exit code is 1 when a target is missed.

    \b
    cholesky   block Cholesky of real systems against CHOLMOD, same matrix and ordering
    bus        an insert of 10 factors with its delta back against a bare Zenoh echo of equal sizes
    idp        inverse-depth features: the 2011 paper's tables and figures with our column, seconds, workers;
               --figures FOLDER, --no-workers
    ros2       a robot's odometry with its transform and its pose back through `factorbus ros2`, against bare Zenoh
    ask        covariances against GTSAM's and a full batch pass, the last pose and all blocks at every step, gates
               of 10,000 candidates; --quick
    batch      whole graphs from file values and from odometry to the optimum, beside GTSAM and g2o: public data sets,
               worlds of 10,000 and 100,000 poses; an hour; --only, --solvers, --seed; --quick: two minutes
    large      whole graphs of 10,000, 100,000 and a million poses to the optimum: time, memory, growth, beside GTSAM
               up to 100,000; three minutes and 10 GB; --poses, --seed, --cores, --page
    every-step the χ² of every published estimate over the batch optimum's from there, beside iSAM2's: simulated
               drives, data sets, and steps that turn much of a map; an hour; --no-isam2: a quarter of that;
               --seeds, --seed, --only simulated|data|hard|NAME,...
    paper      the 2013 paper's evaluation, pose-by-pose replays beside GTSAM's iSAM2 and g2o, with figures; hours,
               goes on where it was stopped; --quick: two minutes
    peers      our default mode against iSAM2 on all public data sets, with bars for time, long steps and quality;
               growth to 100,000 poses, a second core, full passes against CHOLMOD, Python's share; hours;
               --chi2-every N; --quick: two minutes
    fuzz       mutated messages against decoders, admission and a live service: 1.4 million, half an hour
    journal    inserts a second with each durability, in turn, at a window of 32; --folder: on the disk to measure
    soak       a million inserts from 8 clients that are killed and come back: lost, twice, memory, p99;
               --inserts, --minutes
    mixed      six clients that insert, ask, change, fork and drop at once: memory and files, twenty minutes, and a
               service that is killed: the same bits again; --minutes, --clients
    lifelong   100,000 poses round a square, in a map that keeps some and tests its loop closures, of which some are
               false, and a service that is killed 20 times: size, memory, lost, the same bits again; --steps, --false
    digest     the report of every step and the bits of every estimate, as digests; --out FOLDER, --against FOLDER
    calibration   what sensors hide (mounts, scale, frame, clock, bias), found out by simulated drives: how far off in
               units of its covariance; --seeds, --only
    aligning   two maps into one frame, of candidates of which most are false: how often right, wrong, left open;
               --draws, --only
    budget     steps with a budget beside the same steps without one: their time, χ² meanwhile, the newest pose, steps
               until nothing is left for later; --only, --poses, --budget-ms; --bus: clients of a service
    closures   false loop closures, online: streets with shares of false ones (random, local, grouped), tested as they
               come, beside the same solver without a test and with Huber, Cauchy and DCS losses; half an hour
               without the others, hours with; --draws, --only, --shares, --rivals
    inertial   drives with an IMU and GNSS that ship in the gtsam wheel, online, beside iSAM2 with the same factors;
               --only, --every
    ranges     range-only drives that ship in the gtsam wheel, online, beside iSAM2 with the same factors: χ² of
               every step over its batch optimum, and GTSAM's optimum; --only, --every, --steps
    own        a kind of factor written as a formula beside the built-in one, and a Python factor in GTSAM: time of a
               step; --only, --poses
    sessions   a town driven through day after day, in a map that keeps some poses beside one that keeps all: size,
               error of the trajectory, CPU time of a step; --drives, --poses, --seeds, --keep
    sizing     what simulated worlds need: memory of a pose, CPU time of an insert, bytes for a viewer; --worlds,
               --poses, --window
    all        cholesky, bus, idp, ros2 and journal: some minutes

    The benchmarks are in the repository (tests/bench), not in the wheel: they compare with other libraries and read
    the public data sets (FACTORBUS_DATASETS). Further OPTIONS go to the benchmark: factorbus bench bus --help.

    \b
    factorbus bench cholesky
    factorbus bench paper --quick
    factorbus bench every-step --only simulated --seeds 3
    factorbus bench peers --only intel,manhattan3500
    factorbus bench all --json > bench.json
    """
    where = folder()
    names = BENCHES if name == "all" else (name,)
    codes, results = {}, {}
    for each in names:
        print_note(f"bench {each}")
        ran = subprocess.run(
            [sys.executable, str(where / bench_file(each)), *(["--json"] if as_json else []), *options],
            stdout=subprocess.PIPE if as_json else None,
            text=True,
            check=False,
        )
        codes[each] = ran.returncode
        if as_json:
            results[each] = _result(each, ran)
    if as_json:
        document(results if name == "all" else results[name])
    missed = [each for each, code in codes.items() if code]
    if missed:
        print_note(f"bench: {', '.join(missed)} failed or missed a target")
    return FAILED if missed else OK


def folder() -> Path:
    """tests/bench of the checkout that this package is installed from.  Raises Stopped."""
    found = Path(__file__).resolve().parents[4] / "tests" / "bench"
    if not all((found / bench_file(name)).is_file() for name in (*BENCHES, *ASKED, *LONG)):
        raise Stopped(
            "no_repository",
            "the benchmarks are not part of the installed package: clone the repository and run `make bench` there",
        )
    return found


def bench_file(name: str) -> str:
    """The file of a benchmark."""
    return f"{name.replace('-', '_')}.py"


def _result(name: str, ran: "subprocess.CompletedProcess[str]") -> object:
    try:
        return json.loads(ran.stdout)
    except json.JSONDecodeError:
        raise Stopped("bench_failed", f"bench {name} ended with exit code {ran.returncode} and no result") from None
