"""Range-only data sets of the gtsam wheel, online: how a front end would bring them, beacon by beacon.

goats_15 and goats_16 are .pyfg files: an underwater robot and acoustic beacons.  Plaza1 and Plaza2 (a lawn mower and
radio beacons; Djugash, Hamner and Roth, 2009) are tables, which are written as .pyfg here.

Where a beacon is is unknown.  One range is a circle, and ranges from a straight way fit two places, one on each
side of it.  So the ranges to a new beacon wait.  Least squares over the waiting ranges begins at 36 places around the
way; the beacon enters, with all ranges that waited, at the best minimum, once

    there are `FEWEST` ranges from `FEWEST` poses,
    the best minimum is determined: along no axis is its standard deviation above `_UNSURE` of the mean range,
    no other minimum, farther than 3 σ of a range from it, is within `_CLEAR` of its χ².

A beacon that never comes to that never enters, and the row says so.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from bench.replays.columns import F64

from factorbus.formats import read
from factorbus.proto.messages import Batch, Factors, Variables

DATA = Path(gtsam.__file__).parent / "Data"
GOATS = ("goats_15.pyfg", "goats_16.pyfg")
PLAZA = ("Plaza1_.mat", "Plaza2_.mat")
NAMES = {"goats_15": GOATS[0], "goats_16": GOATS[1], "plaza1": PLAZA[0], "plaza2": PLAZA[1]}
FEWEST, _UNSURE, _CLEAR, _STARTS, _PASSES = 6, 0.02, 25.0, 36, 40


@dataclass(frozen=True, slots=True)
class Waiting:
    """Ranges to a beacon that has not entered: keys (2,) of each, pose first, z in metres, Ω packed."""

    keys: list[list[int]]
    z: list[float]
    information: list[F64]


@dataclass(frozen=True, slots=True)
class Entered:
    """When a beacon came in: at which step, with how many ranges, and the χ² of its mirror image over its own."""

    key: int
    step: int
    ranges: int
    clear: float


class Feed:
    """The steps of a drive; `step` asks for the present places of poses while a beacon waits.

    poses: keys in order of time.  file: all of it as it was read, with the file's places of beacons.
    """

    def __init__(self, path: Path, steps: int | None = None) -> None:
        graph = read(path, strict=True)
        self.file = graph.batch
        (poses,) = (group for group in self.file.variables if group.kind == "se2")
        self.poses = np.sort(poses.keys)[:steps]
        self.start = valued(poses)[np.argmin(poses.keys)]
        rank = {key: n for n, key in enumerate(self.poses.tolist())}
        self._odometry: list[list[tuple[list[int], F64, F64]]] = [[] for _ in rank]
        self._ranges: list[list[tuple[list[int], F64, F64]]] = [[] for _ in rank]
        for group in self.file.factors:
            of = {"between_se2": self._odometry, "range_se2": self._ranges}[group.kind]
            for keys, z, information in zip(group.keys.tolist(), group.measured, group.information, strict=True):
                ends = [rank[key] for key in keys if key in rank]
                if len(ends) == (2 if of is self._odometry else 1):
                    of[max(ends)].append((keys, z, information))
        self.waiting: dict[int, Waiting] = {}
        self.entered: list[Entered] = []

    def step(self, n: int, places: dict[int, F64]) -> Batch:
        """What step n brings: a pose, its odometry, its ranges to beacons that are in.  places: of all poses so far."""
        key = int(self.poses[n])
        pose = Variables("se2", np.array([key]), self.start[None] if n == 0 else None, n == 0)
        known = {each.key for each in self.entered}
        ready = [row for row in self._ranges[n] if row[0][1] in known]
        for keys, z, information in self._ranges[n]:
            if keys[1] not in known:
                waits = self.waiting.setdefault(keys[1], Waiting([], [], []))
                waits.keys.append(keys)
                waits.z.append(float(z[0]))
                waits.information.append(information)
        beacons = list(self._found(n, places))
        for beacon, _ in beacons:
            waits = self.waiting.pop(beacon)
            ready += [(k, np.array([z]), w) for k, z, w in zip(waits.keys, waits.z, waits.information, strict=True)]
        variables = [pose]
        if beacons:
            keys = np.array([beacon for beacon, _ in beacons])
            variables.append(Variables("point2", keys, np.array([place for _, place in beacons])))
        factors = [_factors("between_se2", self._odometry[n]), _factors("range_se2", ready)]
        return Batch(tuple(variables), tuple(group for group in factors if group is not None))

    @property
    def unplaced(self) -> bool:
        """Whether a beacon is still to be placed."""
        return len(self.entered) < sum(len(group.keys) for group in self.file.variables if group.kind == "point2")

    def _found(self, n: int, places: dict[int, F64]) -> Iterator[tuple[int, F64]]:
        """Beacons that ranges from poses before this one determine, and where."""
        for key, waits in self.waiting.items():
            rows = [row for row, (pose, _) in enumerate(waits.keys) if pose in places]
            if len({waits.keys[row][0] for row in rows}) < FEWEST or not self._ranges[n]:
                continue
            at = np.array([places[waits.keys[row][0]][:2] for row in rows])
            weights = np.array([waits.information[row][0] for row in rows])
            place, clear = trilaterated(at, np.array([waits.z[row] for row in rows]), weights)
            if place is not None:
                self.entered.append(Entered(key, n, len(waits.z), clear))
                yield key, place


def trilaterated(at: F64, z: F64, weights: F64) -> tuple[F64 | None, float]:
    """(place of a beacon that is `z` (m,) from places `at` (m, 2), how much more the χ² of any other minimum is).

    weights (m,): 1/σ².  The place is None while the ranges leave two, or determine none.
    """
    angles = np.arange(_STARTS) * 2 * np.pi / _STARTS
    x = at.mean(axis=0) + np.mean(z) * np.column_stack([np.cos(angles), np.sin(angles)])
    for _ in range(_PASSES):
        ways = x[:, None] - at[None]
        far = np.maximum(np.linalg.norm(ways, axis=2), 1e-9)
        J, r = ways / far[:, :, None], far - z
        H = np.einsum("smi,smj,m->sij", J, J, weights) + 1e-6 * weights.sum() * np.eye(2)
        moved = np.linalg.solve(H, -np.einsum("smi,sm,m->si", J, r, weights)[:, :, None])[:, :, 0]
        x = x + moved * np.minimum(1.0, np.mean(z) / np.maximum(np.linalg.norm(moved, axis=1), 1e-9))[:, None]
    ways = x[:, None] - at[None]
    far = np.maximum(np.linalg.norm(ways, axis=2), 1e-9)
    chi2 = (weights * (far - z) ** 2).sum(axis=1)
    best = int(np.argmin(chi2))
    J = ways[best] / far[best][:, None]
    others = np.linalg.norm(x - x[best], axis=1) > 3.0 / np.sqrt(weights.mean())
    clear = float(chi2[others].min() - chi2[best]) if others.any() else np.inf
    determined = np.linalg.eigvalsh(J.T * weights @ J)[0] >= (_UNSURE * np.mean(z)) ** -2.0
    return (x[best] if determined and clear >= _CLEAR else None), clear


def feed_of(name: str, folder: Path, steps: int | None = None) -> Feed:
    """The drive of that name, or its first steps.  folder: where the .pyfg of a table may be written."""
    return Feed(file_of(NAMES[name], folder, steps), steps)


def file_of(name: str, folder: Path, steps: int | None = None) -> Path:
    """The data set as a .pyfg."""
    return plaza(DATA / name, folder / f"{name}.pyfg", steps) if name in PLAZA else DATA / name


def true_places(name: str) -> F64 | None:
    """(n, 2) where the poses are by GPS; None where the data set does not say: of goats it has dead reckoning alone."""
    from scipy.io import loadmat

    return loadmat(str(DATA / NAMES[name]))["GT"][:, 1:3] if NAMES[name] in PLAZA else None


def plaza(table: Path, path: Path, steps: int | None = None) -> Path:
    """The first poses of a Plaza data set: odometry, and each range from the pose at or before its time."""
    from scipy.io import loadmat

    tables = loadmat(str(table))
    odometry, ways, far, beacons = tables["DRp"][:steps], tables["DR"], tables["TD"], tables["TL"]
    time = odometry[:, 0]
    lines = [f"VERTEX_SE2 {t:.6f} A{k} {x} {y} {h}" for k, (t, x, y, h) in enumerate(odometry.tolist())]
    lines += [f"VERTEX_XY L{int(name)} {x} {y}" for name, x, y in beacons.tolist()]
    for k, (_, way, turn) in enumerate(ways[: len(time) - 1].tolist()):
        lines.append(f"EDGE_SE2 {time[k]:.6f} A{k} A{k + 1} {way} 0 {turn} 0.0025 0 0 0.0025 0 0.0001")
    for t, _, name, z in far[far[:, 0] < time[-1]].tolist():
        pose = max(int(np.searchsorted(time, t, "right")) - 1, 0)
        lines.append(f"EDGE_RANGE {time[pose]:.6f} A{pose} L{int(name)} {z} 1")
    path.write_text("\n".join(lines) + "\n")
    return path


def valued(group: Variables) -> F64:
    """Its values.  Raises ValueError where it has none."""
    if group.values is None:
        raise ValueError(f"variables of kind {group.kind} have no values")
    return group.values


def _factors(kind: str, rows: list[tuple[list[int], F64, F64]]) -> Factors | None:
    if not rows:
        return None
    keys, z, information = zip(*rows, strict=True)
    return Factors(kind, np.array(keys), np.array(z), np.array(information))
