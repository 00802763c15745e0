"""What is replayed: the data sets of the 2013 paper by name, or simulated worlds where there are none."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from factorbus.formats import read
from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS


@dataclass(frozen=True, slots=True)
class Problem:
    """One replay.

    name      the file's stem, or the world's name
    title     the name in the paper
    poses     the first so many poses only; 0: all.  A world has always a number
    optimum   the lowest χ² known for the whole file (g2o's convention), None where nobody has published it
    seed      of a world; 0: a data set
    """

    name: str
    title: str
    poses: int = 0
    optimum: float | None = None
    seed: int = 0

    @property
    def is_world(self) -> bool:
        """Simulated, not a data set."""
        return self.seed > 0

    @property
    def label(self) -> str:
        """The name that tells a shortened replay and a simulated world from the data set."""
        if self.is_world:
            return f"{self.title} (simulated, {self.poses})"
        return f"{self.title} (first {self.poses})" if self.poses else self.title

    @property
    def key(self) -> str:
        """The name in file names and rows."""
        return f"{self.name}-{self.poses}" if self.poses else self.name

    def shortened(self, poses: int) -> "Problem":
        """The first `poses` poses of it; their optimum is not a published one."""
        return Problem(self.name, self.title, poses, None, self.seed)

    def as_json(self) -> dict[str, object]:
        """For a job's file; `Problem(**...)` is the way back."""
        return asdict(self)


# The optima are the lowest χ² that several solvers from several starts agree on, to nine digits or more.
PAPER = (
    Problem("manhattan3500", "Manhattan", optimum=6532.7447),
    Problem("w10000", "10k", optimum=171545.447),
    Problem("citytrees10000", "CityTrees10k", optimum=8668.9281),
    Problem("intel", "Intel", optimum=546.46111),
    Problem("killian", "Killian", optimum=5.760417e-8),
    Problem("victoria_park", "Victoria Park", optimum=6184.1206),
)
# Stand-ins of a few seconds.
SIMULATED = (
    Problem("manhattan", "Manhattan", poses=1200, seed=1),
    Problem("city_trees", "CityTrees", poses=1200, seed=1),
)
# For a run of two minutes.
QUICK = {"intel": 0, "killian": 0, "manhattan3500": 1000}


def dataset_folder() -> Path:
    """FACTORBUS_DATASETS, or the cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return Path(os.environ.get("FACTORBUS_DATASETS", cache / "factorbus" / "datasets"))


def choose(quick: bool) -> tuple[list[Problem], str]:
    """The problems to replay, and a note for the reader when they are not the paper's data sets."""
    folder = dataset_folder()
    there = [problem for problem in PAPER if (folder / f"{problem.name}.g2o").is_file()]
    if not there:
        worlds = [problem.shortened(600) for problem in SIMULATED] if quick else list(SIMULATED)
        return worlds, (
            f"There are no data sets in {folder} (FACTORBUS_DATASETS): these are simulated worlds, which say nothing "
            "about the paper's table."
        )
    missing = [problem.name for problem in PAPER if problem not in there]
    note = f"Missing in {folder}: {', '.join(missing)}." if missing else ""
    if not quick:
        return there, note
    short = [p.shortened(QUICK[p.name]) if QUICK[p.name] else p for p in there if p.name in QUICK]
    return short, f"{note} A quick run: few data sets, some of them shortened.".strip()


def load(problem: Problem) -> Sequence[Batch]:
    """Its replay: one batch a pose, without values but that of the first pose, which is fixed.  Raises FormatError."""
    if problem.is_world:
        return [step.batch for step in WORLDS[problem.name](problem.poses, problem.seed)]
    steps = read(_file(problem)).steps()
    return steps[: problem.poses] if problem.poses else steps


def fingerprint(problem: Problem) -> str:
    """Changes when the replay does."""
    said = hashlib.sha256(json.dumps([problem.name, problem.poses, problem.seed]).encode())
    if problem.is_world:
        for source in sorted(Path(WORLDS[problem.name].__code__.co_filename).parent.glob("*.py")):
            said.update(source.read_bytes())
    else:
        said.update(_file(problem).read_bytes())
    return said.hexdigest()


def _file(problem: Problem) -> Path:
    return dataset_folder() / f"{problem.name}.g2o"
