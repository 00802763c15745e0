"""Kinds that the solver has, written as own kinds: whatever is true of the one is true of the other."""

from collections.abc import Iterator

import numpy as np
from naive.random_mounts import mount_steps

from factorbus.client.expressions import (
    SE2,
    SE3,
    Expression,
    Point2,
    Point3,
    Vector,
    atan2,
    factor,
    log,
    norm,
    vector_part,
    wrap,
)
from factorbus.proto.kinds import FactorKind
from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver


def _error(e: Expression) -> list[Expression]:
    return [e.position, vector_part(e.rotation)]


@factor
def own_prior_se2(a: SE2, z: SE2):
    return log(z.between(a))


@factor
def own_prior_se3(a: SE3, z: SE3):
    return _error(z.between(a))


@factor
def own_between_se2(a: SE2, b: SE2, z: SE2):
    return log(z.between(a.between(b)))


@factor
def own_between_se3(a: SE3, b: SE3, z: SE3):
    return _error(z.between(a.between(b)))


@factor
def own_landmark_se2(a: SE2, l: Point2, z: Vector[2]):
    return a.inverse().act(l) - z


@factor
def own_landmark_se3(a: SE3, l: Point3, z: Vector[3]):
    return a.inverse().act(l) - z


@factor
def own_bearing_se2(a: SE2, l: Point2, z: Vector[1]):
    seen = a.inverse().act(l)
    return wrap(atan2(seen[1], seen[0]) - z)


@factor
def own_between_se2_mount(a: SE2, b: SE2, m: SE2, z: SE2):
    return log(z.between((a * m).between(b * m)))


@factor
def own_between_se3_mount(a: SE3, b: SE3, m: SE3, z: SE3):
    return _error(z.between((a * m).between(b * m)))


@factor
def own_landmark_se2_mount(a: SE2, l: Point2, m: SE2, z: Vector[2]):
    return (a * m).inverse().act(l) - z


@factor
def own_landmark_se3_mount(a: SE3, l: Point3, m: SE3, z: Vector[3]):
    return (a * m).inverse().act(l) - z


@factor
def own_range_se2_mount(a: SE2, l: Point2, m: SE2, z: Vector[1]):
    return norm((a * m).position - l) - z


@factor
def own_range_se3_mount(a: SE3, l: Point3, m: SE3, z: Vector[1]):
    return norm((a * m).position - l) - z


@factor
def own_bearing_range_se2_mount(a: SE2, l: Point2, m: SE2, z: Vector[2]):
    seen = (a * m).inverse().act(l)
    return [wrap(atan2(seen[1], seen[0]) - z[0]), norm(seen) - z[1]]


@factor
def own_bearing_se3_mount(a: SE3, l: Point3, m: SE3, z: Vector[3]):
    seen = (a * m).inverse().act(l)
    return seen / norm(seen) - z / norm(z)


OWN: dict[str, FactorKind] = {
    kind.called.removeprefix("own_"): kind for kind in list(globals().values()) if isinstance(kind, FactorKind)
}


def both(seed: int, steps: int = 6, loss: str = "") -> Iterator[tuple[Batch, Batch]]:
    """A drive with mounts, all of whose variables come with values; and the same in own kinds."""
    solver, batches = Solver(Options()), list(mount_steps(seed, steps, loss=loss))
    for batch in batches:
        solver.stage(batch)
        solver.step()
    rng, values = np.random.default_rng(seed), dict[int, np.ndarray]()
    for group in solver.estimate():
        values.update(zip(group.keys.tolist(), group.values, strict=True))
    for batch in batches:
        variables = []
        for group in batch.variables:
            rows = np.array([values[key] for key in group.keys.tolist()])
            rows[:, : 3 if "3" in group.kind else 2] += rng.normal(0, 0.02, (len(rows), 3 if "3" in group.kind else 2))
            variables.append(group._replace(values=rows))
        own = [group._replace(kind=OWN[group.kind].name) if group.kind in OWN else group for group in batch.factors]
        yield batch._replace(variables=tuple(variables)), Batch(tuple(variables), tuple(own))
