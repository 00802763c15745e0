"""The classes of GTSAM, and those of GLIM, that stand in a graph of GLIM's: what is in an archive for each.

They are those of GTSAM 4.2 and 4.3 as these are built by default: rotations as matrices, and measurements of an IMU
preintegrated in the tangent space.  Class by class, members in their order, as its `serialize` has them; what nobody
asks for is read to get past it.
"""

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from factorbus.formats.boost_archive import BoostArchive, Read, UnreadableArchive
from factorbus.proto.arrays import F64

BETWEEN, PRIOR, POSITION = "BetweenFactor<Pose3>", "PriorFactor<Pose3>", "PoseTranslationPrior<Pose3>"
DAMPING = "LinearDampingFactor"

_NOISE = "gtsam::noiseModel::"
_ESTIMATORS = ("Null", "Fair", "Huber", "Cauchy", "Tukey", "Welsch", "DCS", "L2WithDeadZone")
_WITH_SQUARES = ("Cauchy", "Welsch")  # in newer versions
_MOST = 1 << 20  # numbers of a matrix
_NOTHING = np.empty(0)
_POSE, _BIAS, _VECTOR3 = "gtsam::Pose3", "gtsam::imuBias::ConstantBias", "gtsam::Vector3"


@dataclass(frozen=True, slots=True)
class Noise:
    """A noise model.

    root (d, d): R of the information RᵀR; empty where there is none, of constraints
    loss: the name of GTSAM's m-estimator, "": none   parameter: the only one of that
    """

    root: F64
    loss: str = ""
    parameter: float = 0.0


_NO_NOISE = Noise(_NOTHING)


@dataclass(frozen=True, slots=True)
class ArchivedFactor:
    """A factor of a graph.

    measured: of a pose its rotation row by row and its translation (12,), of a point (3,); empty: nothing is kept of it
    strength: of a damping, what it adds to the Hessian's first diagonal entry
    """

    name: str
    keys: tuple[int, ...]
    measured: F64 = field(default_factory=lambda: _NOTHING)
    noise: Noise = _NO_NOISE
    strength: float = 0.0


class GtsamForms:
    """Reads the members of classes from an archive.  All raise UnreadableArchive."""

    def __init__(self, archive: BoostArchive, newer: bool) -> None:
        self._from, self._newer = archive, newer
        self._noises: dict[str, Read] = {
            f"{_NOISE}Gaussian": self._gaussian,
            f"{_NOISE}Diagonal": self._diagonal,
            f"{_NOISE}Isotropic": self._isotropic,
            f"{_NOISE}Unit": self._unit,
            "gtsam_noiseModel::Unit": self._unit,  # so GLIM spells it
            f"{_NOISE}Constrained": self._constrained,
            f"{_NOISE}Robust": self._robust,
        }
        self._estimators: dict[str, Read] = {
            f"{_NOISE}mEstimator::{name}": partial(self._estimator, name) for name in _ESTIMATORS
        }
        if not newer:  # then it has more, whose form is not known here
            self._estimators[f"{_NOISE}mEstimator::GemanMcClure"] = partial(self._estimator, "GemanMcClure")
        self._factors: dict[str, Read] = {}
        for short, kind, read in (
            (BETWEEN, (_POSE, _POSE), self._pose),
            (PRIOR, (_POSE,), self._pose),
            (POSITION, (_POSE,), self._vector3),
            ("BetweenFactor<Vector3>", (_VECTOR3, _VECTOR3), self._vector3),
            ("PriorFactor<Vector3>", (_VECTOR3,), self._vector3),
            ("BetweenFactor<imuBias::ConstantBias>", (_BIAS, _BIAS), self._bias),
            ("PriorFactor<imuBias::ConstantBias>", (_BIAS,), self._bias),
        ):
            name = f"gtsam::{short.replace('<', '<gtsam::')}"
            self._factors[name] = partial(self._measuring, short, kind, read)
        for namespace in ("gtsam_points", "gtsam_ext"):  # now, and as it was called
            self._factors[f"{namespace}::{DAMPING}"] = self._damping
            self._factors[f"{namespace}::RotateVector3Factor"] = self._rotated_vector
        self._factors["gtsam::ImuFactor"] = self._imu_factor

    def begin_graph(self) -> int:
        """How many factors a graph has, each of which `factor` reads."""
        counts: list[int] = []

        def begin(_: int) -> None:
            counts.append(self._from.whole())

        graph, base, factors = (
            "gtsam::NonlinearFactorGraph",
            "gtsam::FactorGraph",
            "vector<shared_ptr<NonlinearFactor>>",
        )
        self._object(graph, lambda _: self._object(base, lambda _: self._object(factors, begin)))
        self._from.int32()  # the version of shared_ptr
        return counts[0]

    def factor(self) -> ArchivedFactor | None:
        """The next factor; None for one that was removed."""
        return self._shared("shared_ptr<NonlinearFactor>", self._factors)

    # Factors

    def _measuring(self, short: str, ends: tuple[str, ...], read_measured: Read, _: int) -> ArchivedFactor:
        keys, noise = self._noise_factor(ends)
        return ArchivedFactor(short, keys, read_measured(0), noise)

    def _noise_factor(self, ends: tuple[str, ...]) -> tuple[tuple[int, ...], Noise]:
        """Keys and noise of a NoiseModelFactor of these ends."""

        def of_any(_: int) -> tuple[tuple[int, ...], Noise]:
            keys = self._object("gtsam::NonlinearFactor", self._keys)
            return keys, self._shared("shared_ptr<noiseModel::Base>", self._noises) or _NO_NOISE

        name = f"gtsam::NoiseModelFactorN<{', '.join(ends)}>"
        return self._object(name, lambda _: self._object("gtsam::NoiseModelFactor", of_any))

    def _keys(self, _: int) -> tuple[int, ...]:
        return tuple(self._from.wholes("vector<Key>").tolist())

    def _damping(self, _: int) -> ArchivedFactor:
        """A diagonal that is added to the Hessian: GLIM holds the first pose of a map so."""

        def container(_: int) -> ArchivedFactor:
            keys = self._object("gtsam::NonlinearFactor", self._keys)
            matrix = self._shared("shared_ptr<GaussianFactor>", {"gtsam::HessianFactor": self._hessian})
            self._absent("optional<Values>", "a linear factor with a linearization point")
            return ArchivedFactor(
                DAMPING, keys, strength=float(matrix.flat[0]) if matrix is not None and matrix.size else 0.0
            )

        return self._object("gtsam::LinearContainerFactor", container)

    def _hessian(self, _: int) -> F64:
        def symmetric(_: int) -> F64:
            matrix = self._matrix("gtsam::Matrix")
            self._from.wholes("vector<DenseIndex>")
            self._from.whole()
            return matrix

        self._object("gtsam::GaussianFactor", lambda _: self._object("gtsam::Factor", self._keys))
        return self._object("gtsam::SymmetricBlockMatrix", symmetric)

    def _rotated_vector(self, _: int) -> ArchivedFactor:
        keys, noise = self._noise_factor((_POSE, _VECTOR3))
        return ArchivedFactor("RotateVector3Factor", keys, self._vector3(0), noise)

    def _imu_factor(self, _: int) -> ArchivedFactor:
        keys = self._noise_factor((_POSE, _VECTOR3, _POSE, _VECTOR3, _BIAS))[0]
        self._object("gtsam::PreintegratedImuMeasurements", self._preintegrated)
        return ArchivedFactor("ImuFactor", keys)

    def _preintegrated(self, _: int) -> None:
        def common(_: int) -> None:
            name = "gtsam::PreintegrationParams"
            self._shared("shared_ptr<PreintegrationParams>", {name: self._imu_parameters}, name)
            self._bias(0)
            self._from.real()

        def in_tangent_space(_: int) -> None:
            if self._newer:
                self._object("gtsam::PreintegrationBase", common)
            else:
                common(0)
            self._array("gtsam::Vector9", 9, 1)
            self._array("gtsam::Matrix93", 9, 3)
            self._array("gtsam::Matrix93", 9, 3)

        self._object("gtsam::TangentPreintegration", in_tangent_space)
        self._array("gtsam::Matrix9", 9, 9)

    def _imu_parameters(self, version: int) -> None:
        def of_rotation(_: int) -> None:
            self._matrix("gtsam::Matrix3")
            self._object("optional<Pose3>", lambda _: self._pose(0) if self._from.flag() else None)
            if self._from.flag():
                self._vector3(0)

        self._object("gtsam::PreintegratedRotationParams", of_rotation)
        self._matrix("gtsam::Matrix3")
        self._matrix("gtsam::Matrix3")
        self._from.flag()
        self._vector3(0)
        if version > 0:
            self._from.int32()

    # Noise

    def _gaussian(self, _: int) -> Noise:
        dim = self._object(f"{_NOISE}Base", lambda _: self._from.whole())
        root = self._object("optional<Matrix>", lambda _: self._matrix("gtsam::Matrix") if self._from.flag() else None)
        return Noise(np.eye(min(dim, 64)) if root is None else root)

    def _diagonal(self, _: int) -> Noise:
        self._object(f"{_NOISE}Gaussian", self._gaussian)
        self._vector()
        return Noise(np.diag(self._vector()))

    def _isotropic(self, _: int) -> Noise:
        noise = self._object(f"{_NOISE}Diagonal", self._diagonal)
        self._from.reals(2)
        return noise

    def _unit(self, _: int) -> Noise:
        return self._object(f"{_NOISE}Isotropic", self._isotropic)

    def _constrained(self, _: int) -> Noise:
        self._object(f"{_NOISE}Diagonal", self._diagonal)
        self._vector()
        return Noise(_NOTHING)

    def _robust(self, _: int) -> Noise:
        self._object(f"{_NOISE}Base", lambda _: self._from.whole())
        loss, parameter = self._shared("shared_ptr<mEstimator::Base>", self._estimators) or ("Null", 0.0)
        noise = self._shared("shared_ptr<noiseModel::Base>", self._noises)
        if noise is None:
            raise UnreadableArchive("a robust noise model of none")
        return Noise(noise.root, "" if loss == "Null" else loss, parameter)

    def _estimator(self, name: str, _: int) -> tuple[str, float]:
        self._object(f"{_NOISE}mEstimator::Base", lambda _: self._from.int32())
        parameter = 0.0 if name == "Null" else self._from.real()
        if self._newer and name in _WITH_SQUARES:
            self._from.real()
        return name, parameter

    # Values

    def _pose(self, _: int) -> F64:
        def members(_: int) -> F64:
            rotation = self._object("gtsam::Rot3", lambda _: self._from.reals(9))
            return np.concatenate([rotation, self._vector3(0)])

        return self._object(_POSE, members)

    def _bias(self, _: int) -> F64:
        return self._object(_BIAS, lambda _: np.concatenate([self._vector3(0), self._vector3(0)]))

    def _vector3(self, _: int) -> F64:
        return self._object(_VECTOR3, lambda _: self._from.reals(3))

    def _vector(self) -> F64:
        return self._object("gtsam::Vector", lambda _: self._from.reals(self._size()))

    def _matrix(self, name: str) -> F64:
        def members(_: int) -> F64:
            rows, columns = self._size(), self._size()
            return self._from.reals(rows * columns).reshape(columns, rows).T

        return self._object(name, members)

    def _array(self, name: str, rows: int, columns: int) -> None:
        """Numbers that are an object in newer versions, and just numbers in older ones."""
        if not self._newer:
            self._from.reals(rows * columns)
        elif columns == 1:
            self._object(name, lambda _: self._from.reals(rows))
        else:
            self._matrix(name)

    # Their surroundings

    def _size(self) -> int:
        size = self._from.whole()
        if size > _MOST:
            raise UnreadableArchive(f"a matrix or vector of {size}")
        return size

    def _absent(self, name: str, what: str) -> None:
        if self._object(name, lambda _: self._from.flag()):
            raise UnreadableArchive(f"{what}, whose form is not known here")

    def _shared(self, name: str, reads: dict[str, Read], declared: str = ""):
        return self._object(name, lambda _: self._from.pointer(reads, declared))

    def _object(self, name: str, read: Read):
        return self._from.object(name, read)
