"""Boost's binary archives of GTSAM's graphs: the forms are the wheel's, the bytes are Boost's, and damage is said."""

import base64
import struct
import zlib

import gtsam
import numpy as np
import pytest
from boost_writing import BOOST_1_74, TRACKED, TRACKED_IN_GLIM, Factor, Noise, archives
from hypothesis import given, settings
from hypothesis import strategies as st

from factorbus.formats.boost_archive import BoostArchive, UnreadableArchive
from factorbus.formats.gtsam_archive import archived_graph
from factorbus.formats.gtsam_forms import GtsamForms

B, E, V, X = (getattr(gtsam.symbol_shorthand, letter) for letter in "BEVX")
POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2, 3]))
R, T = POSE.rotation().matrix(), np.array([1.0, 2, 3])
INFORMATION = np.diag([1.0, 2, 3, 4, 5, 6]) + 0.1
BIAS = np.arange(1.0, 7)
_G = "gtsam::"
HEADER = archives([])[1][:40]

# Written by Boost 1.74 from classes with the members of GTSAM's and GLIM's: a damping, two relative poses that share a
# noise model, one with Huber's loss, and one with a whole information.
BY_BOOST = (
    b"c-rk$-AcnS6i&BpcK+5;27)5W-oU#cc8H3Cg7^ZG)i48VQ<_YRZ=!GF+xQ4xdTC9YE=e~TGTF@zv|n?|Ip-tamvlfL3?~E)$qV9yMi8PTcqC7_"
    b"4Q$7DEKrF?ftGyP;GjqiI78umOi9EUgx4g(C^<u6OrpUB3OG$Bv@=qvNVI^bwuJB!Ge%IPbg_Q#QpSpbd3^dyTrAcNA2cWGB&Bu1p>Bv%%%3qX"
    b"3~^i}Zz;n^C!(OH^{5&4uvD{oU{~)QQNr*IeZWHquNdVCjY%L%>XMHwKN==~#fmcZ_WBd={;b&4$aZ_PqO6x|OXH;rFfIP{zfAUAp<hkkinLg#"
    b"p4dQV?qtUEb8s>qEro}iUwAIv13S|dzoY#T<AVCCsp~%IPA?4487Cpi{FvQWqdv~>skN#vzI+d?XSk6)o9c)~8)j?%HYpX!(an@`s}3pG9k8wJ"
    b"gVi(-mxvF4iIcJYZ|8h0=r_ik4{`"
)


def factors() -> list[Factor]:
    iso, root = Noise(6, 1e-3), gtsam.noiseModel.Gaussian.Information(INFORMATION).R()
    return [
        Factor(f"{_G}BetweenFactor<gtsam::Pose3>", (X(0), X(1)), iso, R, T),
        Factor(f"{_G}BetweenFactor<gtsam::Pose3>", (X(1), X(2)), iso, R, T),
        Factor(f"{_G}BetweenFactor<gtsam::Pose3>", (X(0), X(2)), Noise(6, 0.1, huber=1.5), R, T),
        Factor(f"{_G}BetweenFactor<gtsam::Pose3>", (X(2), X(3)), Noise(6, root=root), R, T),
        Factor(f"{_G}PriorFactor<gtsam::Pose3>", (X(0),), iso, R, T),
        Factor(f"{_G}PoseTranslationPrior<gtsam::Pose3>", (X(0),), Noise(3, 0.5), None, T),
        Factor(f"{_G}BetweenFactor<gtsam::imuBias::ConstantBias>", (B(0), B(1)), iso, None, BIAS),
        Factor(f"{_G}PriorFactor<gtsam::imuBias::ConstantBias>", (B(0),), iso, None, BIAS),
    ]


def of_the_wheel() -> gtsam.NonlinearFactorGraph:
    """The same."""
    noise = gtsam.noiseModel
    iso = noise.Isotropic.Sigma(6, 1e-3)
    robust = noise.Robust.Create(noise.mEstimator.Huber.Create(1.5), noise.Isotropic.Sigma(6, 0.1))
    bias = gtsam.imuBias.ConstantBias(BIAS[:3], BIAS[3:])
    graph = gtsam.NonlinearFactorGraph()
    for factor in (
        gtsam.BetweenFactorPose3(X(0), X(1), POSE, iso),
        gtsam.BetweenFactorPose3(X(1), X(2), POSE, iso),
        gtsam.BetweenFactorPose3(X(0), X(2), POSE, robust),
        gtsam.BetweenFactorPose3(X(2), X(3), POSE, noise.Gaussian.Information(INFORMATION)),
        gtsam.PriorFactorPose3(X(0), POSE, iso),
        gtsam.PoseTranslationPrior3D(X(0), POSE, noise.Isotropic.Sigma(3, 0.5)),
        gtsam.BetweenFactorConstantBias(B(0), B(1), bias, iso),
        gtsam.PriorFactorConstantBias(B(0), bias, iso),
    ):
        graph.add(factor)
    return graph


def own() -> list[Factor | None]:
    """Those that the wheel has not, and a place where a factor was removed."""
    damping = Factor("gtsam_points::LinearDampingFactor", (X(0),))
    return [damping, None, Factor("gtsam_points::RotateVector3Factor", (X(0), V(1)), Noise(3, 1e-3), None, T)]


class TextArchive(BoostArchive):
    """A text archive, read by the same forms; `binary` is what the binary one would have had."""

    def __init__(self, text: str) -> None:
        self._tokens = text.split()[:2:-1]  # behind the signature and the version
        self.binary = bytearray(HEADER)
        super().__init__(HEADER)

    @property
    def left(self) -> int:
        return 8 * len(self._tokens)

    def next_whole(self) -> int:
        return int(self._tokens[-1])

    def reals(self, count: int) -> np.ndarray:
        return np.array([self.real() for _ in range(count)])

    def _read_header(self) -> None:
        pass

    def _wholes(self) -> np.ndarray:
        count = self.whole()
        self._tokens.pop()  # the version of the elements
        return np.array([self._number("<q") for _ in range(count)])

    def _name(self) -> str:
        length, name = int(self._tokens.pop()), self._tokens.pop()
        assert len(name) == length
        self.binary += struct.pack("<Q", length) + name.encode()
        return name

    def _number(self, form: str) -> float:
        word = self._tokens.pop()
        number = float(word) if form == "<d" else int(word)
        self.binary += struct.pack(form, number)
        return number


def test_the_text_archive_is_the_wheels_token_by_token() -> None:
    theirs, ours = of_the_wheel().serialize().split(), archives(factors())[0]
    assert len(theirs) == len(ours)
    for one, other in zip(theirs, ours, strict=True):
        assert one == other or float(one) == pytest.approx(float(other), rel=1e-14)


@pytest.mark.parametrize("tracked", [TRACKED, TRACKED_IN_GLIM])
@pytest.mark.parametrize("own_allocator", [False, True])
def test_a_graph_is_read_whole(tracked: tuple[str, ...], own_allocator: bool) -> None:
    content = archives([*own(), *factors()], tracked, BOOST_1_74, own_allocator)[1]
    graph = archived_graph(content)
    assert (graph.missing, graph.why) == (0, "")
    damping, rotated, first, second, robust, whole, prior, position, *biases = graph.factors
    assert (damping.name, damping.keys, damping.strength) == ("LinearDampingFactor", (X(0),), 1e10)
    assert (rotated.name, rotated.keys) == ("RotateVector3Factor", (X(0), V(1)))
    assert (first.keys, second.keys) == ((X(0), X(1)), (X(1), X(2)))
    np.testing.assert_array_equal(first.measured, [*R.ravel(), *T])
    assert second.noise is first.noise, "one noise model that both share"
    np.testing.assert_array_equal(first.noise.root, 1e3 * np.eye(6))
    assert (robust.noise.loss, robust.noise.parameter, robust.noise.root[0, 0]) == ("Huber", 1.5, 10)
    np.testing.assert_allclose(whole.noise.root.T @ whole.noise.root, INFORMATION, rtol=1e-14)
    assert (prior.name, position.name) == ("PriorFactor<Pose3>", "PoseTranslationPrior<Pose3>")
    assert (position.measured.tolist(), position.noise.root[0, 0]) == ([1, 2, 3], 2)
    assert [of.keys for of in biases] == [(B(0), B(1)), (B(0),)]


def test_what_boost_itself_has_written_is_read() -> None:
    graph = archived_graph(zlib.decompress(base64.b85decode(BY_BOOST)))
    assert (graph.missing, graph.why) == (0, "")
    assert [factor.name for factor in graph.factors] == ["LinearDampingFactor"] + 4 * ["BetweenFactor<Pose3>"]
    assert [factor.measured[9:].tolist() for factor in graph.factors[1:]] == [
        [0, 1, 2],
        [1, 2, 3],
        [2, 3, 4],
        [0, 1, 2],
    ]
    assert [factor.noise.loss for factor in graph.factors[1:]] == ["", "", "Huber", ""]
    assert graph.factors[2].noise is graph.factors[1].noise


@pytest.mark.parametrize("name", ["Null", "Fair", "Huber", "Cauchy", "Tukey", "Welsch", "DCS", "L2WithDeadZone"])
def test_m_estimators_are_those_of_the_wheel(name: str) -> None:
    of = getattr(gtsam.noiseModel.mEstimator, name)
    robust = gtsam.noiseModel.Robust.Create(
        of.Create(*([] if name == "Null" else [2.5])), gtsam.noiseModel.Unit.Create(6)
    )
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.BetweenFactorPose3(X(0), X(1), POSE, robust))
    factor = archived_graph(in_binary(graph)).factors[0]
    assert (factor.noise.loss, factor.noise.parameter) == (("", 0.0) if name == "Null" else (name, 2.5))
    np.testing.assert_array_equal(factor.noise.root, np.eye(6))


@pytest.mark.parametrize("is_mounted", [False, True])
def test_imu_factors_are_got_past(is_mounted: bool) -> None:
    parameters = gtsam.PreintegrationParams.MakeSharedU(9.8)
    if is_mounted:
        parameters.setBodyPSensor(POSE)
        parameters.setOmegaCoriolis(np.array([0.0, 0, 7e-5]))
    preintegrated = gtsam.PreintegratedImuMeasurements(parameters)
    preintegrated.integrateMeasurement(np.array([0.1, 0.2, 9.8]), np.array([0.01, 0.02, 0.03]), 0.01)
    graph = gtsam.NonlinearFactorGraph()
    for k in (1, 3):
        graph.add(gtsam.ImuFactor(E(k), V(k), E(k + 1), V(k + 1), B(k), preintegrated))
        graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), POSE, gtsam.noiseModel.Isotropic.Sigma(6, k)))
    read = archived_graph(in_binary(graph))
    assert (read.missing, read.why) == (0, "")
    assert [factor.name for factor in read.factors] == 2 * ["ImuFactor", "BetweenFactor<Pose3>"]
    assert read.factors[2].keys == (E(3), V(3), E(4), V(4), B(3))
    assert read.factors[3].noise.root[0, 0] == pytest.approx(1 / 3)


def in_binary(graph: gtsam.NonlinearFactorGraph) -> bytes:
    """The binary archive of what the wheel writes as text, whose forms are read on the way to its end."""
    archive = TextArchive(graph.serialize())
    forms = GtsamForms(archive, newer=True)
    for _ in range(forms.begin_graph()):
        forms.factor()
    assert archive.left == 0
    return bytes(archive.binary)


def test_the_wheel_itself_reads_no_binary_archive() -> None:
    """Why this is read without it; should it learn to, GLIM's own factors remain unknown to it."""
    with pytest.raises((RuntimeError, UnicodeDecodeError)):
        gtsam.NonlinearFactorGraph().deserialize(archives(factors())[1].decode("latin-1"))
    with pytest.raises(RuntimeError, match="unregistered class"):
        gtsam.NonlinearFactorGraph().deserialize(" ".join(archives([*own()[:1], *factors()])[0]))


def test_an_unknown_factor_ends_the_reading() -> None:
    content = archives([*factors()[:3], Factor("glim::Other", (X(0),)), None, *factors()[3:]])[1]
    graph = archived_graph(content)
    assert (len(graph.factors), graph.missing) == (3, 7)
    assert graph.why == "a glim::Other, whose form is not known here"


@pytest.mark.parametrize("content", [b"", b"PK\3\4", HEADER[:20], b"\0" * 100, HEADER[:30] + b"\xff" * 60])
def test_what_is_no_archive_is_said(content: bytes) -> None:
    graph = archived_graph(content)
    assert graph.factors == ()
    assert graph.why


def test_robust_models_within_each_other_end_somewhere() -> None:
    archive = BoostArchive(HEADER + b"\0\0\0\0\0" + b"\0" * 10_000)

    def within(_: int) -> None:
        archive.object("a", within)

    with pytest.raises(UnreadableArchive, match="within each other"):
        within(0)


GOOD = archives([*own(), *factors()], TRACKED_IN_GLIM, BOOST_1_74)[1]


@given(st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), max_size=4), st.integers(0, len(GOOD)))
@settings(max_examples=300, deadline=None)
def test_damaged_archives_are_read_as_far_as_they_go(changes: list[tuple[int, int]], end: int) -> None:
    content = bytearray(GOOD)
    for place, byte in changes:
        content[place] = byte
    assert len(archived_graph(bytes(content)).factors) <= 10
    cut = archived_graph(GOOD[:end])
    assert (cut.why == "") == (end == len(GOOD))
