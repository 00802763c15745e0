"""Who is measured, by name, and what a run asks of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from typing import Any, Protocol, runtime_checkable

from factorbus.proto.messages import Batch

from .columns import Values


class Failed(Exception):
    """A solver gave up: the run ends here, and its row says why."""


class Contestant(Protocol):
    """One solver in one replay.  `step` and `read` are on the clock, the rest is not."""

    def prepare(self, batch: Batch) -> None:
        """Turn the step's batch into the solver's own objects."""
        ...

    def step(self) -> None:
        """Take them in and solve.  Raises Failed."""
        ...

    def read(self) -> None:
        """The estimate of all variables, as the solver hands it out.  Raises Failed."""
        ...

    def values(self) -> Values:
        """That estimate as arrays."""
        ...

    def facts(self) -> dict[str, Any]:
        """At the end: nnz_r, strategies, and what else there is to tell."""
        ...


@runtime_checkable
class Rehearsing(Protocol):
    """One that has to go through the replay beforehand, off the clock."""

    def rehearse(self, steps: Sequence[Batch], samples: set[int], progress: Callable[[int], None] = ...) -> None:
        """`values` is going to be asked for after `samples` only."""
        ...


@runtime_checkable
class Settling(Protocol):
    """One that can iterate until it has converged."""

    def settle(self) -> None:
        """Do; `values` are those of then."""
        ...


@dataclass(frozen=True, slots=True)
class Entry:
    """A name of the table.

    settings go to the solver; packages are what its version is made of; label is for people; remark explains what
    the timing has in it.
    """

    name: str
    solver: str
    mode: str
    label: str
    settings: dict[str, Any]
    packages: tuple[str, ...]
    remark: str

    def missing(self) -> str:
        """Why it cannot run here; empty when it can."""
        if self.runs_our_kernels:
            from factorbus.solver.options import MODES  # here, so that a peer's process does without our solver

            known = self.solver == RIVAL or self.mode in MODES
            return "" if known else f"mode {self.mode} is not in this build"
        return "" if find_spec(self.packages[0]) else f"{self.packages[0]} is not installed (pip install -e '.[bench]')"

    @property
    def runs_our_kernels(self) -> bool:
        """Ours, or a rival made of our parts."""
        return self.solver in (OURS, RIVAL)

    def versions(self) -> dict[str, str]:
        """Of its packages."""
        return {name: metadata.version(name) for name in self.packages}


OURS, ISAM2, G2O = "factorbus", "gtsam iSAM2", "g2o"
ISAM2_ALONE, RIVAL = "gtsam iSAM2, update alone", "Gauss-Newton on the kernels of factorbus"
OUR_PACKAGES = ("factorbus", "numpy", "numba")


def _ours(mode: str, label: str) -> Entry:
    remark = "stage + step + an estimate of all variables, every step"
    return Entry(mode, OURS, mode, label, {"mode": mode}, OUR_PACKAGES, remark)


def _isam2(threshold: float, factorization: str, wildfire: float = 1e-3) -> Entry:
    short = ("" if factorization == "CHOLESKY" else "-qr") + ("" if wildfire == 1e-3 else "-fine")
    words = ("" if factorization == "CHOLESKY" else ", QR") + ("" if wildfire == 1e-3 else f", wildfire {wildfire:g}")
    remark = "update + calculateEstimate, every step; graph building is outside the clock"
    return Entry(
        f"isam2-{threshold:g}{short}",
        ISAM2,
        f"{threshold:g} {factorization}" + ("" if wildfire == 1e-3 else f" {wildfire:g}"),
        f"GTSAM iSAM2, {threshold:g}{words}",
        {"threshold": threshold, "factorization": factorization, "wildfire": wildfire},
        ("gtsam",),
        remark,
    )


def _isam2_alone(threshold: float, **more: Any) -> Entry:
    """more: of `Isam2Settings`."""
    words = [_SAID[name].format(value) for name, value in more.items()]
    names = "".join(f"-{_SHORT[name].format(value)}" for name, value in more.items())
    return Entry(
        f"isam2-{threshold:g}{names.replace('-as-read', '')}-update" + ("-as-read" if "as_gtsam_reads" in more else ""),
        ISAM2_ALONE,
        ", ".join([f"{threshold:g} CHOLESKY", *words]),
        ", ".join([f"GTSAM iSAM2, {threshold:g}", *words, "update() alone"]),
        {"threshold": threshold, **more},
        ("gtsam",),
        "update and nothing else; graph building and first values are outside the clock",
    )


_SAID = {
    "skip": "skip {}", "adaptive": "adaptive reordering", "partial": "partial relinearization check",
    "as_gtsam_reads": "information as GTSAM reads it",
}  # fmt: skip
_SHORT = {"skip": "skip{}", "adaptive": "adaptive", "partial": "partial", "as_gtsam_reads": "as-read"}


def _gauss_newton() -> Entry:
    return Entry(
        "gn-loop",
        RIVAL,
        "one step at loops",
        "one Gauss-Newton step at loops",
        {},
        OUR_PACKAGES,
        "relinearize, order, analyse, factorize and solve, all of it, once at every step that closes a loop",
    )


def _g2o(every: int) -> Entry:
    remark = "initialize_optimization + Gauss-Newton until the gain is below 1e-6 (10 iterations at most)"
    when = "every step with a loop" if every == 1 else f"every {every} poses, an answer only then"
    label = "g2o, batch each step" if every == 1 else f"g2o, batch every {every}"
    return Entry(f"g2o-b{every}", G2O, f"b{every}", label, {"every": every}, ("g2opy",), f"{when}: {remark}")


ENTRIES = {
    entry.name: entry
    for entry in (
        _g2o(1),
        _g2o(10),
        _isam2(0.1, "CHOLESKY"),
        _isam2(0.01, "CHOLESKY"),
        _isam2(0.1, "QR"),
        _isam2(0.01, "QR"),
        _isam2(0.1, "CHOLESKY", wildfire=1e-5),
        _isam2_alone(0.1),
        _isam2_alone(0.1, as_gtsam_reads=True),
        _isam2_alone(0.1, skip=10),
        _isam2_alone(0.1, skip=10, as_gtsam_reads=True),
        _isam2_alone(0.1, adaptive=True),
        _isam2_alone(0.1, partial=True),
        _isam2_alone(0.01),
        _isam2_alone(0.01, skip=10),
        _gauss_newton(),
        _ours("all-batch", "all-batch Λ"),
        _ours("inc-l", "Inc-L"),
        _ours("inc-l-b10", "Inc-L b10"),
        _ours("inc-l-b100", "Inc-L b100"),
        _ours("bayes-tree", "Bayes tree"),
        _ours("auto", "auto"),
    )
}
# On request: "auto" is one of the others under another name; "fine" shows what iSAM2's default wildfire threshold costs
# in quality where angles weigh much (victoria_park after 2500 poses: 1.47 x the optimum; 1.001 x with 1e-5).
# gn-loop and update() alone are for `bench peers`.
_PEERS = tuple(name for name, entry in ENTRIES.items() if entry.solver == ISAM2_ALONE or name == "gn-loop")
ON_REQUEST = ("auto", "bayes-tree", "isam2-0.1-fine", *_PEERS)
TABLE_1 = tuple(name for name in ENTRIES if name not in ON_REQUEST)
# What `bench peers` calls those that nobody stands in for.
ISAM2_NAMES = {
    name.removesuffix("-update"): name
    for name, entry in ENTRIES.items()
    if entry.solver == ISAM2_ALONE and name.endswith("-update")
}
PEER, SKIPPING = "isam2-0.1-update", "isam2-0.1-skip10-update"
STAND_INS = {PEER: "isam2-0.1-update-as-read", SKIPPING: "isam2-0.1-skip10-update-as-read"}  # where those give up
QUICK = ("g2o-b10", "isam2-0.1", "all-batch", "inc-l", "inc-l-b10", "inc-l-b100")


def make(name: str) -> Contestant:
    """A fresh one."""
    entry = ENTRIES[name]
    return _makers()[entry.solver](**entry.settings)


def make_reading(name: str) -> Contestant:
    """One with the same estimates, all of which can be had: iSAM2's `update()` alone has none without a rehearsal."""
    entry = ENTRIES[name]
    return _makers()[ISAM2 if entry.solver == ISAM2_ALONE else entry.solver](**entry.settings)


def _makers() -> dict[str, Callable[..., Contestant]]:
    """Imports of peers are inside: who is not asked for need not be installed."""

    def ours(mode: str) -> Contestant:
        from .ours import Ours

        return Ours(mode)

    def isam2(**settings: Any) -> Contestant:
        from .isam2 import Isam2, Isam2Settings

        return Isam2(Isam2Settings(**settings))

    def g2o(every: int) -> Contestant:
        from .g2o_batch import G2oBatch

        return G2oBatch(every)

    def isam2_alone(**settings: Any) -> Contestant:
        from .isam2 import Isam2Alone, Isam2Settings

        return Isam2Alone(Isam2Settings(**settings))

    def gauss_newton() -> Contestant:
        from .gn_loop import GaussNewtonAtLoops

        return GaussNewtonAtLoops()

    return {OURS: ours, ISAM2: isam2, ISAM2_ALONE: isam2_alone, G2O: g2o, RIVAL: gauss_newton}
