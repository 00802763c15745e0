"""Drafts of what a sensor measures of which more is a variable: kinds, keys, and places on the Earth."""

from typing import Any

import numpy as np
import pytest
from naive.dense_factors import residual

from factorbus.client import Camera, Draft
from factorbus.client.geodetic import FLATTENING, SEMI_MAJOR_M, ecef, enu
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.problems import BadInformation, BadLoss, BadOption, BadShape, NotFiniteNumbers
from factorbus.proto.symbols import format_symbol, symbol

CAMERA = Camera("pinhole", (500.0, 500.0, 320.0, 240.0))
HERE = (0.0, 0, 0, 0, 0, 0, 1)
ORIGIN = (42.0, -82.0, 200.0)
PLANE, SPACE = {"offset": "d0", "twist": (1, 0, 0.1)}, {"offset": "d0", "twist": (1, 0, 0, 0, 0, 0.1)}
DRAFTED = {
    "range_se2_bias x0 l0 b0": lambda d: d.range_se2("x0", "l0", 2.0, bias="b0", sigmas=0.1),
    "range_se3_bias x0 l0 b0": lambda d: d.range_se3("x0", "l0", 2.0, bias="b0", sigmas=0.1),
    "range_between_se2_bias x0 x1 b0": lambda d: d.range_between_se2("x0", "x1", 2.0, bias="b0", sigmas=0.1),
    "range_between_se3_bias x0 x1 b0": lambda d: d.range_between_se3("x0", "x1", 2.0, bias="b0", sigmas=0.1),
    "between_se2_scale x0 x1 s0": lambda d: d.between_se2("x0", "x1", (1, 0, 0), scale="s0", sigmas=[1] * 3),
    "between_se3_scale x0 x1 s0": lambda d: d.between_se3("x0", "x1", HERE, scale="s0", sigmas=[1] * 6),
    "between_se2_mount x0 x1 m0": lambda d: d.between_se2("x0", "x1", (1, 0, 0), mount="m0", sigmas=[1] * 3),
    "position_se2_arm x0 a0": lambda d: d.position_se2("x0", (1, 2), lever="a0", sigmas=[1] * 2),
    "position_se3_arm x0 a0": lambda d: d.position_se3("x0", (1, 2, 3), lever="a0", sigmas=[1] * 3),
    "position_se2_frame x0 f0": lambda d: d.position_se2("x0", (1, 2), lever=(1, 0), frame="f0", sigmas=[1] * 2),
    "position_se3_frame x0 f0": lambda d: d.gnss("x0", *ORIGIN, origin=ORIGIN, frame="f0", sigmas=[1] * 3),
    "position_se2_frame_arm x0 f0 a0": lambda d: d.position_se2("x0", (1, 2), lever="a0", frame="f0", sigmas=[1] * 2),
    "position_se3_frame_arm x0 f0 a0": lambda d: d.gnss(
        "x0", *ORIGIN, origin=ORIGIN, frame="f0", lever="a0", covariance=np.eye(3)
    ),
    "position_se2_offset x0 d0": lambda d: d.position_se2("x0", (1, 2), **PLANE, sigmas=[1] * 2),
    "position_se3_offset x0 d0": lambda d: d.position_se3("x0", (1, 2, 3), **SPACE, sigmas=[1] * 3),
    "position_se2_frame_offset x0 f0 d0": lambda d: d.position_se2("x0", (1, 2), frame="f0", **PLANE, sigmas=[1] * 2),
    "position_se3_frame_offset x0 f0 d0": lambda d: d.gnss(
        "x0", *ORIGIN, origin=ORIGIN, frame="f0", **SPACE, sigmas=[1] * 3
    ),
    "landmark_se2_offset x0 l0 d0": lambda d: d.landmark_se2("x0", "l0", (1, 0), **PLANE, sigmas=[1] * 2),
    "landmark_se3_offset x0 l0 d0": lambda d: d.landmark_se3("x0", "l0", (1, 0, 0), **SPACE, sigmas=[1] * 3),
    "bearing_range_se2_offset x0 l0 d0": lambda d: d.bearing_range_se2("x0", "l0", (0.1, 2), **PLANE, sigmas=[1] * 2),
    "bearing_se2_offset x0 l0 d0": lambda d: d.bearing_se2("x0", "l0", 0.1, **PLANE, sigmas=1),
    "bearing_se3_offset x0 l0 d0": lambda d: d.bearing_se3("x0", "l0", (1, 0, 0), **SPACE, sigmas=[1] * 3),
    "range_se2_offset x0 l0 d0": lambda d: d.range_se2("x0", "l0", 2.0, **PLANE, sigmas=1),
    "range_se3_offset x0 l0 d0": lambda d: d.range_se3("x0", "l0", 2.0, **SPACE, sigmas=1),
    "point_seen_focal x0 l0 c0": lambda d: d.point_seen("x0", "l0", CAMERA, (1, 2), focal="c0", sigmas=[1] * 2),
    "point_seen_bundler x0 l0 c0": lambda d: d.point_seen("x0", "l0", CAMERA, (1, 2), bundler="c0", sigmas=[1] * 2),
    "point_seen_intrinsics x0 l0 c0": lambda d: d.point_seen(
        "x0", "l0", CAMERA, (1, 2), intrinsics="c0", sigmas=[1] * 2
    ),
    "point_seen_offset x0 l0 d0": lambda d: d.point_seen("x0", "l0", CAMERA, (1, 2), **SPACE, sigmas=[1] * 2),
}


def test_every_kind_with_further_variables_has_its_keywords() -> None:
    made = {name.split()[0] for name in DRAFTED}  # of kinds with a mount one
    assert made >= {name for name, kind in FACTOR_KINDS.items() if kind.base and "mount" not in kind.modifiers}


@pytest.mark.parametrize("wanted", DRAFTED)
def test_keywords_make_the_kind_and_its_keys(wanted: str) -> None:
    (group,) = DRAFTED[wanted](Draft()).batch().factors
    assert " ".join([group.kind, *map(format_symbol, group.keys[0].tolist())]) == wanted
    assert group.measured.shape == (1, FACTOR_KINDS[group.kind].size)


def test_the_twist_stands_behind_what_is_measured() -> None:
    (group,) = Draft().position_se2("x0", (1, 2), lever=(3, 4), **PLANE, sigmas=[1] * 2).batch().factors
    np.testing.assert_array_equal(group.measured, [[1, 2, 3, 4, 1, 0, 0.1]])


def test_what_does_not_go_together_is_refused() -> None:
    with pytest.raises(BadShape, match="offset without twist"):
        Draft().position_se2("x0", (1, 2), offset="d0", sigmas=[1] * 2)
    with pytest.raises(BadShape, match="twist without offset"):
        Draft().position_se2("x0", (1, 2), twist=(1, 0, 0), sigmas=[1] * 2)
    with pytest.raises(BadShape, match="twist"):
        Draft().landmark_se3("x0", "l0", (1, 2, 3), offset="d0", twist=(1, 0, 0), sigmas=[1] * 3)
    with pytest.raises(
        BadOption, match=r"landmark_se2: the keys of mount= and offset=, .*; wanted one of: mount, offset; or"
    ):
        Draft().landmark_se2("x0", "l0", (1, 2), mount="m0", **PLANE, sigmas=[1] * 2)
    with pytest.raises(
        BadOption, match=r"position_se3: the keys of lever= and offset=, .*one of: lever, frame, frame with l"
    ):
        Draft().position_se3("x0", (1, 2, 3), lever="a0", offset="d0", twist=[0] * 6, sigmas=[1] * 3)
    with pytest.raises(BadOption, match="range_se2: the keys of mount= and bias=, which do not go together"):
        Draft().range_se2("x0", "l0", 2.0, mount="m0", bias="b0", sigmas=[1])
    with pytest.raises(BadShape, match="a scale and the mount as numbers"):
        Draft().between_se2("x0", "x1", (1, 0, 0), mount=(1, 0, 0), scale="s0", sigmas=[1] * 3)
    with pytest.raises(BadOption, match="point_seen: the keys of focal= and intrinsics=, which do not go together"):
        Draft().point_seen("x0", "l0", CAMERA, (1, 2), focal="c0", intrinsics="c1", sigmas=1)
    with pytest.raises(BadInformation, match="no keyword 'intrinsics'"):
        Draft().landmark_se3("x0", "l0", (1, 2, 3), intrinsics="c0", sigmas=1)  # type: ignore[call-arg]
    with pytest.raises(BadInformation, match="no keyword 'arm'"):
        Draft().position_se2("x0", (1, 2), lever="a0", arm="a1", sigmas=[1] * 2)  # type: ignore[call-arg]


def test_sigmas_of_another_number_say_what_the_residual_is() -> None:
    """What is measured has other numbers: of a GNSS six, with those of the antenna."""
    for sigmas in (1.0, [1.0] * 6):
        with pytest.raises(BadShape, match=r"gnss x0: sigmas.*wanted \(3,\): of east, north, up \(metres\)"):
            Draft().gnss("x0", 46.0, 7.0, 500.0, origin=(46.0, 7.0, 500.0), sigmas=sigmas)
    with pytest.raises(BadShape, match=r"\(3,\), one for each .*, r = t \+ R λ − \(x y z\), λ on the robot"):
        Draft().position_se3("x0", (1, 2, 3), sigmas=1.0)
    with pytest.raises(BadShape, match=r", r = .* as \(x, y, wrap θ\)$"):
        Draft().between_se2("x0", "x1", (1, 2, 3), sigmas=1.0)
    with pytest.raises(BadShape, match=r"qw ≥ 0; of rotations in radians about x y z$"):
        Draft().between_se3("x0", "x1", (1, 2, 3, 0, 0, 0, 1), sigmas=1.0)


def test_a_known_place_is_where_others_have_computed_it() -> None:
    """X Y Z of MATLAB's geodetic2ecef; an airport of GTSAM's tests, which are GeographicLib's numbers."""
    np.testing.assert_allclose(ecef(ORIGIN), [660675.2518247, -4700948.68316, 4245737.66222], atol=1e-4)
    place = enu((33.87071, -84.30482, 274), (33.86998, -84.30626, 274))
    np.testing.assert_allclose(place, [133.24, 80.98, 0], atol=1e-2)


def test_near_the_origin_metres_are_those_of_the_radii_of_curvature() -> None:
    for latitude in (-75.0, 0.0, 30.0, 89.0):
        here, d = (latitude, 100.0, 50.0), 1e-5
        e2, s = FLATTENING * (2 - FLATTENING), np.sin(np.radians(latitude))
        N = SEMI_MAJOR_M / np.sqrt(1 - e2 * s * s)
        M = N * (1 - e2) / (1 - e2 * s * s)
        east = (N + 50) * np.cos(np.radians(latitude)) * np.radians(d)
        np.testing.assert_allclose(enu((latitude, 100 + d, 50), here), [east, 0, 0], atol=1e-5)
        np.testing.assert_allclose(enu((latitude + d, 100, 50), here), [0, (M + 50) * np.radians(d), 0], atol=1e-5)
        np.testing.assert_allclose(enu((latitude, 100, 57), here), [0, 0, 7], atol=1e-8)


def test_gnss_is_a_position_east_north_and_up_of_the_origin() -> None:
    """The dense residual is zero where the antenna is where it is measured."""
    there, covariance = (42.001, -82.002, 230.0), np.diag([4.0, 9.0, 25.0]) + 0.5
    draft = Draft().gnss("x0", *there, origin=ORIGIN, lever=(0.5, 0, 1), frame="f0", covariance=covariance)
    (group,) = draft.batch().factors
    place = enu(there, ORIGIN)
    frame, robot = np.array([*place - (0.5, 0, 1), 0, 0, 0, 1]), np.array(HERE)
    np.testing.assert_allclose(residual(group.kind, [robot, frame], group.measured[0]), np.zeros(3), atol=1e-9)
    np.testing.assert_allclose(group.information[0], np.linalg.inv(covariance)[np.triu_indices(3)])


def test_places_that_are_none_are_refused() -> None:
    add = Draft().gnss
    with pytest.raises(BadOption, match="gnss x0: place: latitude 100; wanted -90 to 90"):
        add("x0", 100, 0, 0, origin=ORIGIN, sigmas=[1] * 3)
    with pytest.raises(BadOption, match="gnss x0: place: longitude 820; wanted -360 to 360"):
        add("x0", 50, 820, 0, origin=ORIGIN, sigmas=[1] * 3)
    with pytest.raises(BadOption, match="gnss x0: origin: longitude -820"):
        add("x0", 50, 8, 0, origin=(50, -820, 0), sigmas=[1] * 3)
    with pytest.raises(NotFiniteNumbers):
        add("x0", 50, float("nan"), 0, origin=ORIGIN, sigmas=[1] * 3)
    with pytest.raises(BadShape, match="origin"):
        add("x0", 50, 8, 0, origin=(50, 8), sigmas=[1] * 3)
    with pytest.raises(BadShape, match="covariance"):
        add("x0", *ORIGIN, origin=ORIGIN, covariance=np.eye(2))
    with pytest.raises(BadInformation, match="positive definite"):
        add("x0", *ORIGIN, origin=ORIGIN, covariance=-np.eye(3))
    with pytest.raises(BadInformation, match="one of the three"):
        add("x0", *ORIGIN, origin=ORIGIN, covariance=np.eye(3), sigmas=[1] * 3)
    with pytest.raises(BadInformation, match="no keyword 'sigma'"):
        add("x0", *ORIGIN, origin=ORIGIN, sigma=1)  # type: ignore[call-arg]
    with pytest.raises(BadInformation, match="sigmas"):
        add("x0", *ORIGIN, origin=ORIGIN)


@pytest.mark.parametrize("scale", [2, 2.0, np.float64(1.5), np.int64(3)])
def test_a_number_beside_a_loss_by_name_is_not_taken_for_the_key_of_a_scale(scale: Any) -> None:
    sure: Any = {"sigmas": (0.1, 0.1, 0.02), "scale": scale}
    with pytest.raises(BadLoss, match=r'loss=\("huber", '):
        Draft().between_se2("x0", "x1", (1, 0, 0), loss="huber", **sure)
    keyed = Draft().between_se2("x0", "x1", (1, 0, 0), loss="huber", sigmas=(0.1, 0.1, 0.02), scale=int(symbol("s", 0)))
    assert keyed.batch().factors[0].kind == "between_se2_scale"
