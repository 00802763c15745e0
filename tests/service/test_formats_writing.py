"""Writing g2o and TUM, and that what was written is read back bit for bit."""

import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.formats import (
    FormatError,
    Written,
    as_g2o,
    as_jrl,
    as_pyfg,
    g2o_text,
    kitti_text,
    read,
    tum_text,
    write_g2o,
    write_kitti,
    write_tum,
)
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import SeveralRobots
from factorbus.proto.symbols import symbol

WRITABLE = (
    "prior_se2",
    "prior_se3",
    "prior_point2",
    "prior_point3",
    "between_se2",
    "between_se3",
    "landmark_se2",
    "landmark_se3",
    "position_se2",
    "position_se3",
    "bearing_se2",
)
UNWRITABLE = [name for name in FACTOR_KINDS if name not in WRITABLE]
# No record is there for the others.
WRITABLE_VARIABLES = {name: VARIABLE_KINDS[name] for name in ("se2", "se3", "point2", "point3")}
NUMBERS = st.floats(-1e9, 1e9) | st.sampled_from([0.0, -0.0, 5e-324, 1.7e308, 1 / 3])


def letter(kind: str) -> str:
    return "l" if kind.startswith("point") else "x"


def unit(row: np.ndarray) -> np.ndarray:
    """The row with a unit quaternion at its end, if it is an SE3 pose."""
    if len(row) == 7:
        size = np.abs(row[3:]).max()
        quat = row[3:] if 1e-3 < size < 1e12 else np.array([0, 0, 0, 1.0])
        row[3:] = quat / np.linalg.norm(quat)
    return row


@st.composite
def batches(draw: st.DrawFn) -> Batch:
    """Graphs as `read` gives them: per kind fixed ones first, those with a value before those without."""
    ids = iter(draw(st.permutations(range(40))))
    groups, keys = [], {}
    for kind, facts in WRITABLE_VARIABLES.items():
        keys[kind] = []
        for fixed, valued in ((True, True), (False, True)):
            mine = [symbol(letter(kind), next(ids)) for _ in range(draw(st.integers(0, 3)))]
            if mine:
                values = np.array(
                    [unit(np.array(draw(st.lists(NUMBERS, min_size=facts.size, max_size=facts.size)))) for _ in mine]
                )
                groups.append(Variables(kind, np.array(mine), values if valued else None, fixed))
                keys[kind] += mine
    factors = []
    for name in WRITABLE:
        kind = FACTOR_KINDS[name]
        free = [keys[end] for end in kind.connects]
        if all(free) and (free[0] != free[-1] or len(free[0]) > 1):
            count = draw(st.integers(0, 3))
            rows = [draw(st.permutations(free[0]))[:1] + draw(st.permutations(free[-1]))[:1] for _ in range(count)]
            rows = [row[: len(free)] for row in rows if row[0] != row[1]]
            if rows:
                measured = [
                    unit(np.array(draw(st.lists(NUMBERS, min_size=kind.size, max_size=kind.size)))) for _ in rows
                ]
                root = [draw(st.lists(st.floats(-3, 3), min_size=kind.dim**2, max_size=kind.dim**2)) for _ in rows]
                full = [np.reshape(r, (kind.dim, kind.dim)) for r in root]
                if name.startswith("position"):  # g2o has no antenna beside its pose
                    measured = [np.pad(row[: kind.dim], (0, kind.dim)) for row in measured]
                packed = [(m.T @ m + np.eye(kind.dim))[np.triu_indices(kind.dim)] for m in full]
                factors.append(Factors(name, np.array(rows), np.array(measured), np.array(packed)))
    return Batch(tuple(groups), tuple(sorted(factors, key=lambda group: list(FACTOR_KINDS).index(group.kind))))


def assert_same(one: Batch, other: Batch) -> None:
    assert [(g.kind, g.fixed) for g in one.variables] == [(g.kind, g.fixed) for g in other.variables]
    for a, b in zip(one.variables, other.variables, strict=True):
        np.testing.assert_array_equal(a.keys, b.keys)
        assert (a.values is None) == (b.values is None)
        if a.values is not None and b.values is not None:
            assert a.values.tobytes() == b.values.tobytes()
    assert [g.kind for g in one.factors] == [g.kind for g in other.factors]
    for a, b in zip(one.factors, other.factors, strict=True):
        np.testing.assert_array_equal(a.keys, b.keys)
        assert a.measured.tobytes() == b.measured.tobytes()
        assert a.information.tobytes() == b.information.tobytes()


@given(batch=batches().filter(lambda batch: batch.variable_count > 0))
def test_what_is_written_is_read_back_bit_for_bit(tmp_path_factory: pytest.TempPathFactory, batch: Batch) -> None:
    path = tmp_path_factory.mktemp("round") / "a.g2o"
    write_g2o(path, batch)
    assert_same(read(path).batch, batch)


def small() -> Batch:
    poses = Variables("se2", np.array([symbol("x", 0), symbol("x", 1)]), np.array([[0, 0, 0], [1, 0.5, math.pi / 2]]))
    point = Variables("point2", np.array([symbol("l", 7)]), None, fixed=True)
    edge = Factors(
        "between_se2",
        np.array([[symbol("x", 0), symbol("x", 1)]]),
        np.array([[1, 0.5, 0.1]]),
        np.array([[1, 0, 0, 1, 0, 1.0]]),
    )
    observation = Factors(
        "landmark_se2", np.array([[symbol("x", 1), symbol("l", 7)]]), np.array([[2, -0.0]]), np.array([[1, 0, 1.0]])
    )
    return Batch((poses, point), (edge, observation))


def test_text_of_g2o() -> None:
    assert g2o_text(small()) == (
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0.5 1.5707963267948966\nFIX 7\n"
        "EDGE_SE2 0 1 1 0.5 0.1 1 0 0 1 0 1\nEDGE_SE2_XY 1 7 2 -0 1 0 1\n"
    )
    out = io.StringIO()
    write_g2o(out, small())
    assert out.getvalue() == g2o_text(small())


def test_keys_that_share_a_number_are_written_whole(tmp_path: Path) -> None:
    batch = small()
    shared = np.array([symbol("l", 1)])
    batch = Batch(
        (batch.variables[0], Variables("point2", shared, np.array([[3.0, 4.0]]))),
        (
            Factors(
                "landmark_se2", np.array([[symbol("x", 1), shared[0]]]), np.array([[2, 1.0]]), np.array([[1, 0, 1.0]])
            ),
        ),
    )
    path = tmp_path / "a.g2o"
    (note,) = write_g2o(path, batch)
    assert "ids are keys" in note
    assert f"VERTEX_XY {shared[0]} 3 4\n" in path.read_text()
    assert_same(read(path).batch, batch)
    counted = g2o_text(batch, ids="counted")
    assert "VERTEX_XY 2 3 4\n" in counted
    assert "EDGE_SE2_XY 1 2 2 1 1 0 1\n" in counted
    with pytest.raises(FormatError, match="keys that their numbers do not tell apart"):
        g2o_text(batch, ids="ids")
    with pytest.raises(FormatError, match="ids 'many'; wanted one of auto"):
        g2o_text(batch, ids="many")


@pytest.mark.parametrize("kind", UNWRITABLE)
def test_kinds_without_a_record_are_left_out_and_said(tmp_path: Path, kind: str) -> None:
    facts, batch = FACTOR_KINDS[kind], small()
    keys = np.array([[symbol("f", 10 * end + 9) for end in range(len(facts.connects))]])
    others = tuple(
        Variables(name, keys[0, end : end + 1], np.ones((1, VARIABLE_KINDS[name].size)))
        for end, name in enumerate(facts.connects)
    )
    factor = Factors(kind, keys, np.ones((1, facts.size)), np.eye(facts.dim)[np.triu_indices(facts.dim)][None])
    whole = Batch((*batch.variables, *others), (*batch.factors, factor))
    written = as_g2o(whole)
    assert written.left_out[kind] == 1
    assert f"1 {kind} left out: g2o has no record for such factors" in written.notes
    assert written.text.count("EDGE_") == 2
    path = tmp_path / "a.g2o"
    with pytest.raises(FormatError, match=r"nothing that would be left out \(strict\)"):
        write_g2o(path, whole, strict=True)
    assert not path.exists()


def test_losses_and_antennas_beside_the_pose_are_left_out_and_said() -> None:
    batch = small()
    edge, observation = batch.factors
    robust = edge._replace(loss="huber", scale=np.array([1.0]))
    antenna = Factors("position_se2", edge.keys[:, :1], np.array([[1, 2, 0.5, 0]]), np.array([[1, 0, 1.0]]))
    written = as_g2o(Batch(batch.variables, (robust, observation, antenna)))
    assert written.text == g2o_text(batch)
    assert written.left_out == {"between_se2 loss": 1, "position_se2": 1}
    assert written.notes[0] == (
        "1 between_se2 loss left out: g2o has no losses: the factors are written without their huber"
    )
    keys, measured = np.repeat(edge.keys, 2, 0), np.repeat(edge.measured, 2, 0)
    twice = Factors(edge.kind, keys, measured, np.repeat(edge.information, 2, 0), "huber", np.ones(2))
    assert as_g2o(Batch(batch.variables, (twice, observation))).notes[0].startswith("2 between_se2 losses left out: ")
    with pytest.raises(FormatError, match="1 between_se2 loss"):
        g2o_text(Batch(batch.variables, (robust, observation)), strict=True)


def test_what_is_left_out_of_several_groups_is_said_once_for_the_file() -> None:
    """A map has a group of a kind that is fixed, and one that is not; a kind of factor by its losses."""
    poses = [np.array([symbol("x", k)]) for k in range(4)]
    at = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    batch = Batch(
        (
            Variables("se3", poses[0], at, True, np.array([1])),
            Variables("se3", poses[1], at, False, np.array([2])),
            Variables("se3", poses[2]),
            Variables("se3", poses[3], None, True),
            Variables("idp", np.array([symbol("f", 1)]), np.ones((1, 6))),
            Variables("idp", np.array([symbol("f", 2)]), np.ones((1, 6)), True),
        ),
        tuple(
            Factors("between_se3", np.stack(poses[:2], 1), at, np.eye(6)[np.triu_indices(6)][None], "huber", np.ones(1))
            for _ in range(3)
        ),
    )
    written = as_g2o(batch)
    assert written.notes == (
        "2 time stamps left out: g2o has no record for the time of se3 variables",
        "2 idp left out: g2o has no record for such variables",
        "3 between_se3 losses left out: g2o has no losses: the factors are written without their huber",
        "2 variables left out: neither a value nor an edge tells of x2, x3",
    )
    assert written.left_out == {"time stamps": 2, "idp": 2, "between_se3 loss": 3, "variables": 2}
    with pytest.raises(FormatError, match="2 time stamps, g2o has no record"):
        as_g2o(batch, strict=True)


def test_variable_that_nothing_tells_of_is_left_out_and_said() -> None:
    lonely = Variables("se2", np.array([symbol("x", 3)]))
    written = as_g2o(Batch((lonely,)))
    assert written.left_out == {"variables": 1}
    assert written.notes == ("1 variable left out: neither a value nor an edge tells of x3",)
    with pytest.raises(FormatError, match="a factor of x0, which is not in the graph"):
        g2o_text(Batch((), small().factors))


def test_text_of_tum(tmp_path: Path) -> None:
    space = Variables("se3", np.array([symbol("x", 12)]), np.array([[1, 2, 3, 0.5, 0.5, 0.5, -0.5]]))
    batch = Batch((space, *small().variables))
    rows = [line.split() for line in tum_text(batch).splitlines()]
    assert [row[0] for row in rows] == ["0", "1", "12"]
    half = math.sin(math.pi / 4), math.cos(math.pi / 4)
    assert [float(word) for word in rows[1][1:]] == [1, 0.5, 0, 0, 0, *half]
    assert [float(word) for word in rows[2][1:]] == [1, 2, 3, 0.5, 0.5, 0.5, -0.5]
    write_tum(tmp_path / "a.tum", batch)
    assert (tmp_path / "a.tum").read_text() == tum_text(batch)


@pytest.mark.parametrize(("text", "write"), [(tum_text, write_tum), (kitti_text, write_kitti)])
def test_a_trajectory_is_one_robots(tmp_path: Path, text: Callable, write: Callable) -> None:
    one = Variables("se2", np.array([symbol("a", k) for k in (0, 2, 4, 6)]), np.array([[k, 0, 0.0] for k in range(4)]))
    two = Variables(
        "se2", np.array([symbol("b", k) for k in (7, 1, 3, 5)]), np.array([[k, 100, 0.0] for k in range(4)])
    )
    bare = Variables("se2", np.array([1403636579763555584]), np.ones((1, 3)))
    batch = Batch((two, one, bare))
    with pytest.raises(SeveralRobots, match="keys without a letter, a, b, and none was chosen") as caught:
        text(batch)
    assert caught.value.detail == {"robots": ["", "a", "b"]}
    with pytest.raises(SeveralRobots, match="none is 'c'"):
        text(batch, "c")
    files = write(tmp_path / "out.txt", batch)
    assert [file.name for file in files] == ["out.txt", "out-a.txt", "out-b.txt"]
    for file, robot, alone in zip(files, ("", "a", "b"), (bare, one, two), strict=True):
        assert file.read_text() == text(batch, robot) == text(Batch((alone,)))
        assert len(file.read_text().splitlines()) == len(alone.keys)
    assert write(tmp_path / "b.txt", batch, "b") == [tmp_path / "b.txt"]
    assert (tmp_path / "b.txt").read_text() == text(batch, "b")
    with pytest.raises(FormatError, match="x1 has no value"):
        text(Batch((Variables("se2", np.array([symbol("x", 1)])),)))
    assert text(Batch(())) == ""


def test_a_time_stamp_as_a_key_keeps_all_its_digits() -> None:
    stamps = [1403636579763555584, 1403636579763555585]
    batch = Batch((Variables("se2", np.array(stamps), np.zeros((2, 3))),))
    assert [line.split()[0] for line in tum_text(batch).splitlines()] == list(map(str, stamps))
    assert [line.split()[1] for line in g2o_text(batch).splitlines()] == list(map(str, stamps))


def test_text_of_kitti(tmp_path: Path) -> None:
    """The same poses as in TUM form, as matrices; a quarter turn about z takes x to y."""
    space = Variables("se3", np.array([symbol("x", 12)]), np.array([[1, 2, 3, 0.5, 0.5, 0.5, -0.5]]))
    batch = Batch((space, *small().variables))
    rows = np.array([[float(word) for word in line.split()] for line in kitti_text(batch).splitlines()])
    poses = rows.reshape(-1, 3, 4)
    np.testing.assert_allclose(poses[1], [[0, -1, 0, 1], [1, 0, 0, 0.5], [0, 0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(poses[2], [[0, 1, 0, 1], [0, 0, 1, 2], [1, 0, 0, 3]], atol=1e-15)
    write_kitti(tmp_path / "a.kitti", batch)
    assert (tmp_path / "a.kitti").read_text() == kitti_text(batch)


# Positive definite, and with an inverse beyond what a double holds.
WITHOUT_COVARIANCE = ([5e-324, 0, 0, 1, 0, 1], [1, 0, 0, 1e-310, 0, 1], [1e-320, 0, 0, 1e-320, 0, 1e-320])


@pytest.mark.parametrize("information", WITHOUT_COVARIANCE)
@pytest.mark.parametrize("form", [as_jrl, as_pyfg], ids=["jrl", "pyfg"])
def test_what_has_no_covariance_is_left_out_of_a_form_that_has_them(
    form: Callable[..., Written], information: list[float], tmp_path: Path
) -> None:
    batch = small()
    edge, _ = batch.factors
    both = Factors(edge.kind, np.repeat(edge.keys, 2, 0), np.repeat(edge.measured, 2, 0), np.eye(6)[[0, 0]])
    both.information[:] = [[1.0, 0, 0, 1, 0, 1], information]
    written = form(Batch(batch.variables, (both,)))
    assert written.left_out["between_se2"] == 1
    assert "1 between_se2 left out: the information matrix has no inverse" in " ".join(written.notes)
    path = tmp_path / f"out.{'jrl' if form is as_jrl else 'pyfg'}"
    path.write_text(written.text)
    assert read(path).batch.factor_count == 1


@pytest.mark.parametrize("form", [as_jrl, as_pyfg], ids=["jrl", "pyfg"])
def test_a_certainty_at_the_end_of_what_a_double_holds_is_read_back(
    form: Callable[..., Written], tmp_path: Path
) -> None:
    batch = small()
    edge, _ = batch.factors
    sure = edge._replace(information=np.array([[1e308, 0, 0, 1e308, 0, 1]]))
    path = tmp_path / f"out.{'jrl' if form is as_jrl else 'pyfg'}"
    path.write_text(form(Batch(batch.variables, (sure,))).text)
    np.testing.assert_allclose(read(path).batch.factors[0].information, sure.information, rtol=1e-9)
