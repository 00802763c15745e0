"""Where sensors sit on their robots (PARAMS_SE2OFFSET, PARAMS_SE3OFFSET), composed into what they measured.

A sensor at P on its pose X stands at X P.  What g2o measures from there becomes what we measure from X:

    a point      e = (X P)⁻¹ l − z        r = R_P e                     z' = P z,        Ω' = R_P Ω R_Pᵀ        exact
    a pose       e = z⁻¹ (X P)            e' = P e P⁻¹,  r_e = A r_e'   z' = z P⁻¹,      Ω' = Aᵀ Ω A
    two poses    e = z⁻¹ (Xᵢ P)⁻¹ (Xⱼ Q)   e' = Q e Q⁻¹,  r_e = A r_e'   z' = P z Q⁻¹,    Ω' = Aᵀ Ω A

In EDGE_SE3_XYZ_PRIOR and EDGE_SE2_POINTXY_OFFSET g2o does not apply the offset, and so it is not applied here.

A is that of MATH (3.28): of the last two z' is exact, and Ω' to first order in the error, exact without a lever arm.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.left_out import LeftOut
from factorbus.formats.lines import Bucket
from factorbus.formats.numbers import read_numbers
from factorbus.formats.records import OFFSETS
from factorbus.formats.rotations import compose_poses, inverse_poses, normalized_poses, rotation_matrices
from factorbus.formats.weights import packed_upper, unpacked_symmetric
from factorbus.proto.arrays import F64, I64

# A camera of g2o has a place on its pose too, and a landmark edge may name a camera: x y z q, fx fy cx cy, baseline.
_CAMERAS = {"PARAMS_CAMERACALIB": 4, "PARAMS_STEREOCAMERACALIB": 5}
_FIELDS = {"se2": "id x y theta", "se3": "id x y z qx qy qz qw"}


@dataclass(frozen=True, slots=True)
class Offsets:
    """By dimension ("se2", "se3") the place (x y theta, or x y z qx qy qz qw) for each number of a parameter.

    cameras: the places of cameras; camera_lines: (record, number, line) of each of them.
    """

    places: Mapping[str, Mapping[int, F64]]
    cameras: Mapping[int, F64]
    camera_lines: tuple[tuple[str, int, int], ...] = ()

    def of(self, file: str, name: str, space: str, lines: I64, parameters: I64) -> F64:
        """The places (n, 3 or 7) of `parameters` (n,).  Raises FormatError for one that no line declares."""
        known = {**(self.cameras if space == "se3" else {}), **self.places[space]}
        unknown = np.array([number not in known for number in parameters.tolist()], bool)
        identity = "0 0 0" if space == "se2" else "0 0 0 0 0 0 1"
        first = parameters[int(np.argmax(unknown))] if len(unknown) else 0
        refuse_first(
            file,
            lines,
            unknown,
            lambda row: f"{name} with parameter {parameters[row]}, which no line declares",
            f"a line PARAMS_{space.upper()}OFFSET {first} {identity}",
        )
        return np.array([known[number] for number in parameters.tolist()]).reshape(len(lines), -1)


def read_offsets(file: str, buckets: Mapping[str, Bucket]) -> Offsets:
    """The offsets that a g2o file declares.  Raises FormatError."""
    places = {
        space: _declared(file, name, space, buckets[name])[0] if name in buckets else {}
        for name, space in OFFSETS.items()
    }
    cameras: dict[int, F64] = {}
    stand = []
    for name, more in _CAMERAS.items():
        if name in buckets:
            found, ids = _declared(file, name, "se3", buckets[name], more)
            cameras |= found
            stand += [(name, number, line) for number, line in zip(ids, buckets[name].numbers, strict=True)]
    return Offsets(places, cameras, tuple(stand))


def leave_cameras(offsets: Offsets, named: set[int], left: LeftOut) -> None:
    """Say which cameras are left out: all but those whose place an edge takes.  Raises FormatError when strict."""
    needed = named - set(offsets.places["se3"])
    for record in _CAMERAS:
        unused = [line for name, number, line in offsets.camera_lines if name == record and number not in needed]
        left.leave(record, unused, "no edge that is read here needs a camera")


def _declared(file: str, name: str, space: str, bucket: Bucket, more: int = 0) -> tuple[dict[int, F64], list[int]]:
    """(places by number, the numbers line by line)."""
    width = {"se2": 4, "se3": 8}[space]
    fields = _FIELDS[space] + (", and what the camera is" if more else "")
    ids, numbers = read_numbers(file, name, bucket, 1, width + more, fields)
    lines = np.array(bucket.numbers, np.int64)
    poses = numbers[:, : width - 1]
    if space == "se3":
        poses = normalized_poses(file, name, lines, poses)
    found: dict[int, F64] = {}
    for number, pose, line in zip(ids[:, 0].tolist(), poses, bucket.numbers, strict=True):
        if number in found and (found[number] != pose).any():
            raise FormatError(file, line, f"{name} {number} again, with other numbers", "one place for a parameter")
        found[number] = pose
    return found, ids[:, 0].tolist()


def seen_from_pose(kind: str, places: list[F64], measured: F64, information: F64) -> tuple[F64, F64]:
    """(measured, information) in terms of the poses themselves.  Rows without an offset are kept bit for bit.

    in   kind: of the factor   places: of each parameter (n, 3 or 7)   measured (n, size)   information packed
    """
    moved = is_moved(places)
    if not moved.any():
        return measured, information
    new, weights = measured.copy(), information.copy()
    rows = [place[moved] for place in places]
    new[moved], weights[moved] = _moved(kind, rows, measured[moved], information[moved])
    return new, weights


def is_moved(places: list[F64]) -> NDArray[np.bool]:
    """Whether any of a row's places is not the pose's own: (n,)."""
    return np.any([place != _identity(place.shape[1]) for place in places], axis=(0, 2))


def has_lever(kind: str, places: list[F64]) -> bool:
    """Whether the weight of some row is carried over to first order alone."""
    length = 2 if places[-1].shape[1] == 3 else 3
    return kind.startswith(("prior", "between")) and bool((places[-1][:, :length] != 0).any())


def _identity(size: int) -> F64:
    return np.array([0.0] * (size - 1) + [1.0 if size == 7 else 0.0])


def _moved(kind: str, places: list[F64], measured: F64, information: F64) -> tuple[F64, F64]:
    last = places[-1]
    if kind.startswith("landmark"):
        R = rotation_matrices(last)
        length = measured.shape[1]
        return last[:, :length] + np.einsum("nij,nj->ni", R, measured), _carried(information, np.swapaxes(R, 1, 2))
    z = compose_poses(measured, inverse_poses(last))
    if kind.startswith("between"):
        z = compose_poses(places[0], z)
    return z, _carried(information, _adjoints(last))


def _carried(information: F64, A: F64) -> F64:
    """Aᵀ Ω A, packed as Ω is."""
    Omega = unpacked_symmetric(information, A.shape[1])
    return packed_upper(np.swapaxes(A, 1, 2) @ Omega @ A)


def _adjoints(places: F64) -> F64:
    """A of MATH (3.28) for each place: (n, 3, 3) or (n, 6, 6)."""
    Qt = np.swapaxes(rotation_matrices(places), 1, 2)
    if places.shape[1] == 3:
        A = np.tile(np.eye(3), (len(places), 1, 1))
        A[:, :2, :2] = Qt
        A[:, :2, 2] = np.einsum("nij,nj->ni", Qt, np.stack([-places[:, 1], places[:, 0]], axis=1))
        return A
    x, y, z = places[:, :3].T
    zero = np.zeros(len(places))
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    A = np.zeros((len(places), 6, 6))
    A[:, :3, :3] = A[:, 3:, 3:] = Qt
    A[:, :3, 3:] = -2.0 * Qt @ cross
    return A
