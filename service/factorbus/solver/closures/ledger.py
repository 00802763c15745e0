"""All closures of one kind that a map was given, as columns, and what has become of each."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver.closures.motions import motions_of_poses
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.factor_graph import with_room
from factorbus.solver.graph.groups import FactorGroup, FactorsLike
from factorbus.solver.kernels.jit.compile import F64, I64

ACCEPTED, SUSPECT, REJECTED, RESTORED = "accepted", "suspect", "rejected", "restored"
NEW = "new"
POSES_BETWEEN = {"between_se2": 3, "between_se3": 7}  # numbers of a pose
_COLUMNS = ("z", "noise", "weight", "ends", "looked", "is_suspect", "is_tested")


@dataclass(slots=True, eq=False)
class Closure:
    """One closure.

    number: in the order they came, of all kinds; row: in its ledger.  came, changed, looked: steps, when it came, when
    its state last changed, when it was last looked at.  reason: why its state is what it is.  distance: d², chance: of
    a false one to be within the gate, both when it was last looked at.  factor_id: in the solver, −1: it has none.
    """

    number: int
    row: int
    factor: FactorGroup
    came: int
    state: str = SUSPECT
    reason: str = "new"
    distance: float = float("nan")
    chance: float = float("nan")
    changed: int = 0
    looked: int = 0
    factor_id: int = -1

    @property
    def is_in(self) -> bool:
        """Whether the estimate has it."""
        return self.factor_id >= 0


class UnknownClosure(SolverError):
    """A number that no closure has."""

    code = "unknown_closure"

    def __init__(self, number: int, count: int) -> None:
        have = f"they are 0 to {count - 1}" if count else "there is none yet"
        super().__init__(f"there is no closure {number}: {have}; `closures` has them", closure=number)


class Ledger:
    """Closures of one kind.

    z (n, k, k), noise, weight (n, d, d): what was measured, Ω⁻¹ and Ω in its tangent space, metres and radians.
    ends (n, 2): variables.  is_suspect, is_tested (n,): whether it may go in, and whether it is in and may go out.
    looked (n,): the step.  All have room behind for more.
    """

    def __init__(self, kind: str) -> None:
        self.kind, self.size, self.dim = kind, POSES_BETWEEN[kind], 3 if kind == "between_se2" else 6
        self.closures: list[Closure] = []
        k, d = 3 if self.dim == 3 else 4, self.dim
        self.z, self.noise, self.weight = np.zeros((0, k, k)), np.zeros((0, d, d)), np.zeros((0, d, d))
        self.ends, self.looked = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
        self.is_suspect, self.is_tested = np.zeros(0, bool), np.zeros(0, bool)

    def add(self, factor: FactorGroup, number: int, ends: I64, step: int) -> Closure:
        """One more; a suspect at first."""
        n = len(self.closures)
        if n == len(self.z):
            for name in _COLUMNS:
                setattr(self, name, with_room(getattr(self, name), n + 1))
        self.z[n] = motions_of_poses(factor.measured)[0]
        self.noise[n], self.weight[n] = _certainty(factor, self.dim)
        self.ends[n], self.looked[n] = ends, step
        self.closures.append(Closure(number, n, factor, step))
        self.move(self.closures[n], SUSPECT, NEW, step)
        return self.closures[n]

    def move(self, closure: Closure, state: str, reason: str, step: int) -> None:
        """Its state changes."""
        closure.state, closure.reason, closure.changed = state, reason, step
        self.is_suspect[closure.row], self.is_tested[closure.row] = state == SUSPECT, state == ACCEPTED

    def suspects(self) -> I64:
        """Rows."""
        return np.flatnonzero(self.is_suspect[: len(self.closures)])

    def tested(self) -> I64:
        """Rows."""
        return np.flatnonzero(self.is_tested[: len(self.closures)])


def pick_rows(group: FactorsLike, chosen: np.ndarray | I64) -> FactorGroup:
    """Some factors of a group."""
    scale = None if group.scale is None else group.scale[chosen]
    picked = group.keys[chosen], group.measured[chosen], group.information[chosen]
    return FactorGroup(group.kind, *picked, group.loss, scale)


def _certainty(factor: FactorGroup, d: int) -> tuple[F64, F64]:
    """Ω⁻¹ and Ω in metres and radians: the residual of a rotation in space is half its angle."""
    omega = np.zeros((d, d))
    rows, columns = np.triu_indices(d)
    omega[rows, columns] = omega[columns, rows] = factor.information[0]
    if d == 6:
        halves = np.array([1.0] * 3 + [0.5] * 3)
        omega *= halves[:, None] * halves
    return np.asarray(np.linalg.inv(omega), np.float64), omega
