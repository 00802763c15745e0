"""Write graphs as GTSAM and Boost.Serialization write them: into the binary archive, and beside it into the text one.

The wheel of GTSAM writes text archives, which the tests hold these to, token by token; the binary one comes from the
same calls.  Of GLIM's own factors, which the wheel has not, these are the lines of their `serialize`.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

BOOST_1_74, BOOST_1_87 = 18, 20  # the versions of the library, as archives have them
# Classes whose objects are numbered, as the wheel has them; those of pointers are as well.
TRACKED = ("NonlinearFactorGraph", "Isotropic", "Diagonal", "Gaussian", "Pose3", "Rot3", "ConstantBias")
# GLIM exports more of them.
TRACKED_IN_GLIM = (*TRACKED, "NonlinearFactor", "NoiseModelFactor", "GaussianFactor")
Write = Callable[[], None]


@dataclass(frozen=True, eq=False)
class Noise:
    """sigma: of an isotropic one; root: of a Gaussian; huber: the width of a robust one around it."""

    dim: int
    sigma: float = 0.0
    root: np.ndarray | None = None
    huber: float = 0.0


@dataclass(frozen=True, eq=False)
class Factor:
    """One of GTSAM's or GLIM's, by the name of its class."""

    name: str
    keys: tuple[int, ...]
    noise: Noise | None = None
    rotation: np.ndarray | None = None
    vector: np.ndarray | None = None


class ArchiveWriter:
    """Both archives of the same objects."""

    def __init__(self, tracked: tuple[str, ...] = TRACKED, library: int = BOOST_1_87) -> None:
        self.tokens: list[str] = ["22", "serialization::archive", str(library)]
        self.binary = bytearray(struct.pack("<Q22sH4Bi", 22, b"serialization::archive", library, 4, 8, 4, 8, 1))
        self._tracked = set(tracked)
        self._classes: list[str] = []
        self._said: set[str] = set()
        self._numbers: dict[int, int] = {}
        self._kept: list[object] = []  # so that no identity comes twice
        self._count = 0

    def put(self, form: str, value: float) -> None:
        self.tokens.append(repr(value) if form == "d" else str(int(value)))
        self.binary += struct.pack(f"<{form}", value)

    def reals(self, numbers: object) -> None:
        for number in np.asarray(numbers, float).ravel(order="F").tolist():
            self.put("d", number)

    def wholes(self, name: str, numbers: tuple[int, ...], own_allocator: bool = False) -> None:
        """A vector of primitives, of whose class nothing is said unless it has an allocator of its own."""
        self._register(name)
        if own_allocator and name not in self._said:
            self._said.add(name)
            self.put("B", False)
            self.put("I", 0)
        self.put("Q", len(numbers))
        self.tokens.append("0")  # the version of the elements, in text alone
        for number in numbers:
            self.put("q", number)

    def object(self, name: str, write: Write, version: int = 0) -> None:
        self._register(name)
        self._content(name, object(), write, version)

    def pointer(self, name: str, it: object, write: Write) -> None:
        is_new = name not in self._classes
        self._register(name)
        self.put("h", self._classes.index(name))
        if is_new:
            self.tokens += [str(len(name)), name]
            self.binary += struct.pack("<Q", len(name)) + name.encode()
        self._tracked.add(name)
        self._content(name, it, write, 0)

    def _register(self, name: str) -> None:
        if name not in self._classes:
            self._classes.append(name)

    def _content(self, name: str, it: object, write: Write, version: int) -> None:
        is_tracked = name in self._tracked or name.rpartition("::")[2] in self._tracked
        if name not in self._said:
            self._said.add(name)
            self.put("B", is_tracked)
            self.put("I", version)
        if is_tracked:
            number = self._numbers.setdefault(id(it), self._count)
            self.put("I", number)
            if number < self._count:
                return
            self._kept.append(it)
            self._count += 1
        write()


def archives(
    factors: list[Factor | None],
    tracked: tuple[str, ...] = TRACKED,
    library: int = BOOST_1_87,
    own_allocator: bool = False,
) -> tuple[list[str], bytes]:
    """(the tokens of the text archive, the binary archive) of a NonlinearFactorGraph.  None: a factor was removed."""
    to = ArchiveWriter(tracked, library)
    writer = _GraphWriter(to, own_allocator)

    def elements() -> None:
        to.put("Q", len(factors))
        to.put("I", 1)
        for factor in factors:
            to.object("shared_ptr<factor>", lambda factor=factor: writer.factor(factor), 1)

    to.object("NonlinearFactorGraph", lambda: to.object("FactorGraph", lambda: to.object("vector", elements)))
    return to.tokens, bytes(to.binary)


class _GraphWriter:
    """own_allocator: of the vectors of keys, as where GTSAM is built with TBB's."""

    def __init__(self, to: ArchiveWriter, own_allocator: bool) -> None:
        self._to, self._own_allocator = to, own_allocator

    def factor(self, factor: Factor | None) -> None:
        if factor is None:
            self._to.put("h", -1)
            return
        write = {
            "gtsam_points::LinearDampingFactor": self._damping,
            "gtsam_points::RotateVector3Factor": lambda it: self._measuring(it, "N<Pose3,Vector3>"),
            "gtsam::BetweenFactor<gtsam::Pose3>": lambda it: self._measuring(it, "N<Pose3,Pose3>"),
            "gtsam::PriorFactor<gtsam::Pose3>": lambda it: self._measuring(it, "N<Pose3>"),
            "gtsam::PoseTranslationPrior<gtsam::Pose3>": lambda it: self._measuring(it, "N<Pose3>"),
            "gtsam::BetweenFactor<gtsam::imuBias::ConstantBias>": lambda it: self._measuring(it, "N<Bias,Bias>"),
            "gtsam::PriorFactor<gtsam::imuBias::ConstantBias>": lambda it: self._measuring(it, "N<Bias>"),
        }.get(factor.name, lambda it: self._to.reals([1.0, 2.0]))
        self._to.pointer(factor.name, factor, lambda: write(factor))

    def _measuring(self, factor: Factor, ends: str) -> None:
        def of_any() -> None:
            self._to.object("NonlinearFactor", lambda: self._keys(factor))
            self._to.object("shared_ptr<noise>", lambda: self._noise(factor.noise), 1)

        self._to.object(ends, lambda: self._to.object("NoiseModelFactor", of_any))
        if factor.rotation is not None:
            self._to.object("Pose3", lambda: self._pose(factor))
        elif "Bias" in factor.name:
            self._to.object(
                "ConstantBias", lambda: (self._vector3(factor.vector[:3]), self._vector3(factor.vector[3:]))
            )
        else:
            self._vector3(factor.vector)

    def _keys(self, factor: Factor) -> None:
        self._to.wholes("vector<Key>", factor.keys, self._own_allocator)

    def _pose(self, factor: Factor) -> None:
        self._to.object("Rot3", lambda: self._to.reals(factor.rotation.T))  # row by row
        self._vector3(factor.vector)

    def _vector3(self, numbers: np.ndarray) -> None:
        self._to.object("Vector3", lambda: self._to.reals(numbers))

    def _noise(self, noise: Noise) -> None:
        name = "Robust" if noise.huber else "Gaussian" if noise.root is not None else "Isotropic"
        write = {"Robust": self._robust, "Gaussian": self._gaussian, "Isotropic": self._isotropic}[name]
        self._to.pointer(f"gtsam::noiseModel::{name}", noise, lambda: write(noise))

    def _robust(self, noise: Noise) -> None:
        self._base(noise)
        self._to.object("shared_ptr<mEstimator>", lambda: self._huber(noise), 1)
        within = Noise(noise.dim, noise.sigma, noise.root)
        self._to.object("shared_ptr<noise>", lambda: self._noise(within), 1)

    def _huber(self, noise: Noise) -> None:
        def members() -> None:
            self._to.object("mEstimator::Base", lambda: self._to.put("i", 1))
            self._to.put("d", noise.huber)

        self._to.pointer("gtsam::noiseModel::mEstimator::Huber", object(), members)

    def _isotropic(self, noise: Noise) -> None:
        def diagonal() -> None:
            self._to.object("gtsam::noiseModel::Gaussian", lambda: self._gaussian(noise))
            for sigma in (noise.sigma, 1 / noise.sigma):
                self._vector(np.full(noise.dim, sigma))

        self._to.object("gtsam::noiseModel::Diagonal", diagonal)
        self._to.reals([noise.sigma, 1 / noise.sigma])

    def _gaussian(self, noise: Noise) -> None:
        def root() -> None:
            self._to.put("B", noise.root is not None)
            if noise.root is not None:
                self._matrix(noise.root)

        self._base(noise)
        self._to.object("optional<Matrix>", root, 1)

    def _base(self, noise: Noise) -> None:
        self._to.object("noiseModel::Base", lambda: self._to.put("Q", noise.dim))

    def _vector(self, numbers: np.ndarray) -> None:
        self._to.object("Vector", lambda: (self._to.put("Q", len(numbers)), self._to.reals(numbers)))

    def _matrix(self, numbers: np.ndarray) -> None:
        def members() -> None:
            self._to.put("Q", numbers.shape[0])
            self._to.put("Q", numbers.shape[1])
            self._to.reals(numbers)

        self._to.object("Matrix", members)

    def _damping(self, factor: Factor) -> None:
        """A LinearContainerFactor of a HessianFactor: a diagonal, and nothing else."""

        def container() -> None:
            self._to.object("NonlinearFactor", lambda: self._keys(factor))
            write = lambda: self._to.pointer("gtsam::HessianFactor", object(), lambda: self._hessian(factor))  # noqa: E731
            self._to.object("shared_ptr<GaussianFactor>", write, 1)
            self._to.object("optional<Values>", lambda: self._to.put("B", False), 1)

        self._to.object("LinearContainerFactor", container)

    def _hessian(self, factor: Factor) -> None:
        def blocks() -> None:
            self._matrix(np.diag([*[1e10] * 6, 0.0]))
            self._to.wholes("vector<DenseIndex>", (0, 6, 7), False)
            self._to.put("q", 0)

        self._to.object("GaussianFactor", lambda: self._to.object("Factor", lambda: self._keys(factor)))
        self._to.object("SymmetricBlockMatrix", blocks)
