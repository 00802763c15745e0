"""What is replayed: public data sets by name, or simulated worlds where there are none."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from factorbus import simulate
from factorbus.datasets import CATALOGUE, Places, dataset_named, find, locate
from factorbus.formats import read
from factorbus.proto.messages import Batch

from . import worlds
from .worlds import WORLDS


@dataclass(frozen=True, slots=True)
class Problem:
    """One replay.

    name      the file's stem, or the world's name
    title     the name in the paper
    poses     how many first poses only; 0: all.  A world has always a number
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
            return f"{self.title} (simulated, {self.poses}, seed {self.seed})"
        return f"{self.title} (first {self.poses})" if self.poses else self.title

    @property
    def key(self) -> str:
        """The name in file names and rows."""
        parts = (self.name, self.poses, self.seed) if self.is_world else (self.name, self.poses)
        return "-".join(str(part) for part in parts if part)

    @property
    def steps(self) -> int:
        """How many a replay has: one a pose."""
        return self.poses or dataset_named(self.name, CATALOGUE).poses

    def shortened(self, poses: int) -> "Problem":
        """The first `poses` poses of it; their optimum is not a published one."""
        return Problem(self.name, self.title, poses, None, self.seed)

    def as_json(self) -> dict[str, object]:
        """For a job's file; `Problem(**...)` is the way back."""
        return asdict(self)


# The optima are the lowest χ² that several solvers from several starts agree on, to nine digits or more.
ALL = tuple(Problem(each.name, each.paper or each.name, optimum=each.optimum) for each in CATALOGUE)
PAPER = tuple(problem for problem, each in zip(ALL, CATALOGUE, strict=True) if each.paper)
# Stand-ins of a few seconds.
SIMULATED = (
    Problem("manhattan", "Manhattan", poses=1200, seed=1),
    Problem("city_trees", "CityTrees", poses=1200, seed=1),
)
# Seeds of worlds that may be looked at while constants are chosen; of the others each run draws one.
LOOKED_AT = 1
WORLD_POSES, QUICK_POSES = 2000, 300
_TITLES = {"manhattan": "Streets", "city_trees": "Trees by streets"}
# For a run of two minutes.
QUICK = {"intel": 0, "killian": 0, "manhattan3500": 1000}


def choose(quick: bool, of: Sequence[Problem] = PAPER) -> tuple[list[Problem], str]:
    """The problems to replay, and a note for the reader when they are not all of those data sets.

    A data set is looked for by name: in FACTORBUS_DATASETS, in the cache, in the gtsam wheel.
    """
    places = Places.of_this_machine()
    there = [problem for problem in of if locate(dataset_named(problem.name, CATALOGUE), places)]
    missing = [problem.name for problem in of if problem not in there]
    note = f"Not on this machine: {', '.join(missing)} (factorbus datasets fetch --all)." if missing else ""
    if quick:
        there = [p.shortened(QUICK[p.name]) if QUICK[p.name] else p for p in there if p.name in QUICK]
        note = f"{note} A quick run: few data sets, some of them shortened.".strip()
    if there:
        return there, note
    worlds = [problem.shortened(600) for problem in SIMULATED] if quick else list(SIMULATED)
    return worlds, f"{note} These are simulated worlds, which say nothing about the data sets."


def drawn(seed: int, poses: int = WORLD_POSES) -> list[Problem]:
    """Every world twice: with the seed that may be looked at, and with this one."""
    titles = {name: _TITLES.get(name, name.replace("_", " ").capitalize()) for name in WORLDS}
    return [Problem(name, title, poses, None, each) for name, title in titles.items() for each in (LOOKED_AT, seed)]


def load(problem: Problem) -> Sequence[Batch]:
    """Its replay: one batch a pose, without values but that of the first pose, which is fixed.  Raises FormatError."""
    if problem.is_world:
        return [*WORLDS[problem.name](problem.poses, problem.seed)]
    steps = read(file_of(problem.name)).steps()
    return steps[: problem.poses] if problem.poses else steps


def fingerprint(problem: Problem) -> str:
    """Changes when the replay does."""
    said = hashlib.sha256(json.dumps([problem.name, problem.poses, problem.seed]).encode())
    if problem.is_world:
        for source in (Path(worlds.__file__), *sorted(Path(simulate.__file__).parent.glob("*.py"))):
            said.update(source.read_bytes())
    else:
        said.update(file_of(problem.name).read_bytes())
    return said.hexdigest()


def file_of(name: str) -> Path:
    """The file of a data set; what only the gtsam wheel has is converted into the cache.  Raises DatasetProblem,
    FileNotFoundError."""
    path = find(name)
    if path is None:
        raise FileNotFoundError(f"data set {name} is not on this machine: factorbus datasets fetch {name}")
    return path
