"""Files as other programs write them: each opens, and its optimum is that of g2o, which read it too."""

import re
from pathlib import Path

import numpy as np
import pytest

from factorbus.formats import FormatError, GraphFile, read, write_g2o
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import solve_batch

INFO3 = "1 0 0 1 0 1"
INFO6 = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 4 0 0 4 0 4"
SQUARE = ["0 0 0", "1 0 1.57", "1 1 3.14", "0 1 -1.57"]
LOOP = ["1 0 1.55", "1 0 1.6", "1 .1 1.5", "1 0 1.57"]
LOOP_CHI2 = 0.004921420012155


def loop(ids: tuple[int, ...] = (0, 1, 2, 3), before: str = "", behind: tuple[str, ...] = ("",) * 4) -> str:
    """Four poses around a square."""
    vertices = [f"VERTEX_SE2 {number} {at}" for number, at in zip(ids, SQUARE, strict=True)]
    ends = zip(ids, (*ids[1:], ids[0]), strict=True)
    edges = [f"EDGE_SE2 {i} {j} {z} {INFO3}{more}" for (i, j), z, more in zip(ends, LOOP, behind, strict=True)]
    return before + "\n".join([*vertices, *edges]) + "\n"


def read_text(folder: Path, text: str, name: str = "a.g2o", dialect: str | None = None) -> GraphFile:
    path = folder / name
    path.write_text(text)
    return read(path, dialect)


def chi2(graph: GraphFile, use_values: bool = True) -> float:
    whole = graph.whole(use_values)
    return solve_batch(whole.variables, whole.factors).chi2


def in_space(ids: tuple[int, ...]) -> str:
    """Four poses in a row that turn a little, and an edge back to the first."""
    turn = "0 0 0.0099998333 0.99995"
    vertices = [f"VERTEX_SE3:QUAT {number} {k} 0 0 0 0 0 1" for k, number in enumerate(ids)]
    edges = [f"EDGE_SE3:QUAT {ids[k]} {ids[k + 1]} 1 {0.05 * k} 0 {turn} {INFO6}" for k in range(3)]
    return "\n".join([*vertices, *edges, f"EDGE_SE3:QUAT {ids[3]} {ids[0]} -3 0.1 0 0 0 0 1 {INFO6}"]) + "\n"


SEEN = (
    "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nVERTEX_TRACKXYZ 2 2 1 0\nFIX 0\n"
    f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFO6}\n"
    "EDGE_SE3_TRACKXYZ 0 2 0 2 1 0 1 0 0 1 0 1\nEDGE_SE3_TRACKXYZ 1 2 0 1.1 1 0 1 0 0 1 0 1\n"
)
LINE = [f"VERTEX_SE2 {k} {k} 0 0" for k in range(10)] + [f"EDGE_SE2 {k} {k + 1} 1 0 0.1 {INFO3}" for k in range(9)]
POSITIONS = ["5 10 10", "9 14 11", "0 5 9"]

# text, χ² at the optimum, how many lines of each record are left out
OPENS = {
    "GTSAM's symbols": (in_space(tuple(symbol("a", k) for k in range(4))), 0.006274534633, {}),
    "labelled symbols": (loop((27303072740933632, 1, 2, 3)), LOOP_CHI2, {}),
    "time stamps": (loop((1403636579763555584, 1, 2, 3)), LOOP_CHI2, {}),
    "RTAB-Map": (loop((1, 2, 3, 4), "PARAMS_SE2OFFSET 0 0 0 0\n", (" 0", " 0", " 0", " 1")), LOOP_CHI2, {}),
    "laser scans": (
        loop(before="ROBOTLASER1 0 -1.57 3.14 0.017 30 0.1 0 3 1 2 3\n" * 2),
        LOOP_CHI2,
        {"ROBOTLASER1": 2},
    ),
    "images": (loop(before="RGBD_DATA 0 a.png b.png\n"), LOOP_CHI2, {"RGBD_DATA": 1}),
    "unknown vertices": (loop(before="VERTEX_FISH 7 1\n"), LOOP_CHI2, {"VERTEX_FISH": 1}),
    "a pose alone": (loop() + "VERTEX_SE2 9 5 5 0\n", LOOP_CHI2, {"vertices": 1}),
    "a landmark unseen": (loop() + "VERTEX_XY 20 3 3\n", LOOP_CHI2, {"vertices": 1}),
    "comments": (loop(before="# VERTEX\n", behind=("", "#x", " # y", " # loop")), LOOP_CHI2, {}),
    "offset": ("PARAMS_SE3OFFSET 0 0.1 0 0.5 0 0 0 1\n" + SEEN, 0.00258535361, {}),
    "identity": ("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n" + SEEN, 0.00267980137, {}),
    "camera unused": (
        "PARAMS_CAMERACALIB 0 9 9 9 0 0 0 1 500 500 320 240\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n" + SEEN,
        0.00267980137,
        {"PARAMS_CAMERACALIB": 1},
    ),
    # To g2o both are parameter 0, and the first stays.  In versions where a ParameterCamera is a ParameterSE3Offset the
    # edge takes its place, which is the same here.  In g2o 2.3 it is none, but is read as one unchecked: a point at
    # (x, y, z) is predicted at (z, 0, 0), so the 2.334492698 that it has of this file mean nothing.
    "camera of the sensor's number": (
        "PARAMS_CAMERACALIB 0 0 0 0 0 0 0 1 500 500 320 240\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n" + SEEN,
        0.00267980137,
        {"PARAMS_CAMERACALIB": 1},
    ),
    "camera of another number": (
        "PARAMS_CAMERACALIB 1 9 9 9 0 0 0 1 500 500 320 240\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n" + SEEN,
        0.00267980137,
        {"PARAMS_CAMERACALIB": 1},
    ),
    "camera as the sensor": ("PARAMS_CAMERACALIB 0 0.1 0 0.5 0 0 0 1 500 500 320 240\n" + SEEN, 0.00258535361, {}),
    "positions": (
        "\n".join([*LINE, *(f"EDGE_PRIOR_SE2_XY {z} 1 0 1" for z in POSITIONS)]) + "\n",
        121.8515497,
        {},
    ),
    "positions as RTAB-Map has them": (
        "\n".join([*LINE, *(f"EDGE_PRIOR_XY {z} 1 0 1" for z in POSITIONS)]) + "\n",
        121.8515497,
        {},
    ),
}


@pytest.mark.parametrize("case", OPENS)
def test_it_opens_at_the_right_optimum(tmp_path: Path, case: str) -> None:
    text, right, left_out = OPENS[case]
    graph = read_text(tmp_path, text)
    assert chi2(graph) == pytest.approx(right, rel=1e-8)
    assert chi2(graph, use_values=False) == pytest.approx(right, rel=1e-8)
    assert graph.left_out == left_out
    for name, count in left_out.items():
        assert any(
            re.search(f"{count} {name[:4]}\\S* (left out|that replay and solve leave out): ", note)
            for note in graph.notes
        )
    if left_out:
        with pytest.raises(FormatError, match=r"nothing that would (have to )?be left out \(strict\)"):
            read(tmp_path / "a.g2o", strict=True)
    else:
        assert read(tmp_path / "a.g2o", strict=True).notes == graph.notes


@pytest.mark.parametrize("case", ["GTSAM's symbols", "labelled symbols", "time stamps", "RTAB-Map"])
def test_ids_come_out_as_they_went_in(tmp_path: Path, case: str) -> None:
    def ids(text: str) -> list[tuple[str, ...]]:
        return [tuple(line.split()[: 2 + line.startswith("EDGE")]) for line in text.splitlines() if "SE" in line[:9]]

    graph = read_text(tmp_path, "\n".join(line for line in OPENS[case][0].splitlines() if "PARAMS" not in line) + "\n")
    out = tmp_path / "out.g2o"
    write_g2o(out, graph.batch, ids="auto" if graph.numbering == "ids" else graph.numbering)
    given = (tmp_path / "a.g2o").read_text()
    assert sorted(ids(out.read_text())) == sorted(ids(given))
    assert chi2(read(out)) == pytest.approx(OPENS[case][1], rel=1e-8)


def test_symbols_are_keys_with_their_letters(tmp_path: Path) -> None:
    graph = read_text(tmp_path, f"EDGE_SE2_XY {symbol('b', 3)} {symbol('p', 4)} 1 2 1 0 1\n")
    assert [group.keys.tolist() for group in graph.batch.variables] == [[symbol("b", 3)], [symbol("p", 4)]]
    assert graph.numbering == "keys"


def test_one_symbol_among_plain_ids_leaves_every_id_as_it_is_and_says_so(tmp_path: Path) -> None:
    text = loop() + f"EDGE_SE2_XY 1 {symbol('l', 7)} 1 2 1 0 1\n"
    graph = read_text(tmp_path, text)
    keys = {group.kind: group.keys.tolist() for group in graph.batch.variables}
    assert keys == {"se2": [0, 1, 2, 3], "point2": [symbol("l", 7)]}
    (note,) = graph.notes
    assert note.startswith("4 of 5 ids are below 2^56, the others symbols as GTSAM packs them, or time stamps: ")
    assert "every id is the key itself, so 0, 1, 2, 3 have no letter" in note
    write_g2o(tmp_path / "out.g2o", graph.batch, ids=graph.numbering)
    assert read(tmp_path / "out.g2o").batch.variables[0].keys.tolist() == [0, 1, 2, 3]
    assert read_text(tmp_path, f"EDGE_SE2_XY {symbol('b', 3)} {symbol('p', 4)} 1 2 1 0 1\n").notes == ()


@pytest.mark.parametrize("ids", ["auto", "keys"])
def test_keys_without_letters_are_said_to_get_some_where_the_file_is_read(tmp_path: Path, ids: str) -> None:
    bare = Batch((Variables("se2", np.array([3, 4]), np.zeros((2, 3))),))
    (note,) = write_g2o(tmp_path / "out.g2o", bare, ids=ids)
    assert note == "no key has a letter, and a file of such ids says none: reading gives poses x and points l"
    assert read(tmp_path / "out.g2o").batch.variables[0].keys.tolist() == [symbol("x", 3), symbol("x", 4)]


def test_a_letter_for_each_small_id_even_when_gtsam_numbers_points_apart(tmp_path: Path) -> None:
    text = "VERTEX_SE2 1 0 0 0\nVERTEX_XY 1 1 1\nEDGE_SE2_XY 1 1 1 1 1 0 1\n"
    graph = read_text(tmp_path, text)
    assert graph.numbering == "apart"
    out = tmp_path / "out.g2o"
    write_g2o(out, graph.batch, ids=graph.numbering)
    assert out.read_text() == text


def test_a_switchable_edge_has_a_loss(tmp_path: Path) -> None:
    more = "VERTEX_SWITCH 4 1\nEDGE_SWITCH_PRIOR 4 1 9\nEDGE_SE2_SWITCHABLE 2 0 4 0 0 0 2 0 0 2 0 2\n"
    graph = read_text(tmp_path, loop() + more + "EDGE_SE2_SWITCHABLE 3 1 5 1 0 0 1 0 0 1 0 1\n")
    (robust,) = (group for group in graph.batch.factors if group.loss)
    assert (robust.kind, robust.loss) == ("between_se2", "dcs")
    np.testing.assert_array_equal(robust.keys, [[symbol("x", 2), symbol("x", 0)], [symbol("x", 3), symbol("x", 1)]])
    assert robust.scale is not None
    np.testing.assert_allclose(robust.scale, [3, 1])
    assert graph.left_out == {"VERTEX_SWITCH": 1, "EDGE_SWITCH_PRIOR": 1}
    assert any("2 EDGE_SE2_SWITCHABLE read with the loss dcs" in note for note in graph.notes)
    assert [len(step.factors) for step in graph.steps()] == [0, 1, 2, 2]
    assert graph.steps()[3].factors[1].loss == "dcs"


def test_a_switch_of_no_edge_is_not_said_to_be_a_loss(tmp_path: Path) -> None:
    graph = read_text(tmp_path, loop() + "VERTEX_SWITCH 4 1\nEDGE_SWITCH_PRIOR 4 1 9\n")
    assert not [group for group in graph.batch.factors if group.loss]
    assert list(graph.notes) == [
        f"1 {name} left out: no edge that is read has a switch" for name in ("VERTEX_SWITCH", "EDGE_SWITCH_PRIOR")
    ]


@pytest.mark.parametrize(("weight", "is_null"), [("1e-2", True), ("1e-9", False), ("0", False)])
def test_a_mixture_is_its_likelier_component(tmp_path: Path, weight: str, is_null: bool) -> None:
    """At the values of the file: rᵀΩr = 2 + 3.14², and 1.5 ln w against −(1 − w) times that."""
    graph = read_text(tmp_path, loop() + f"EDGE_SE2_MAXMIX 0 2 {weight} 0 0 0 {INFO3}\n")
    edges = next(group for group in graph.batch.factors if group.kind == "between_se2")
    scale = float(weight) if is_null else 1.0
    np.testing.assert_allclose(edges.information[-1], scale * np.array([1, 0, 0, 1, 0, 1.0]))
    assert f"{1 - is_null} as measured, {int(is_null)} as the null hypothesis" in graph.notes[0]


def test_a_mixture_is_refused_where_nothing_may_be_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(loop() + f"EDGE_SE2_MAXMIX 0 2 0.5 0 0 0 {INFO3}\n")
    with pytest.raises(FormatError, match="EDGE_SE2_MAXMIX, of whose components one is read") as refused:
        read(path, strict=True)
    assert refused.value.line == 9


def test_a_mixture_in_space(tmp_path: Path) -> None:
    text = in_space((0, 1, 2, 3)) + f"EDGE_SE3_MAXMIX 0 3 1e-2 0 50 0 0 0 0 1 {INFO6}\n"
    edges = read_text(tmp_path, text).batch.factors[0]
    np.testing.assert_allclose(edges.information[-1], 1e-2 * edges.information[0])


def test_isam_is_assumed_and_slampp_can_be_said(tmp_path: Path) -> None:
    info = "45 0 0 45 0 400"
    rows = [("0 1", "1 0 1.57"), ("1 2", "1 0 1.57"), ("2 3", "1 0 1.57"), ("0 3", "0 1.1 -1.5")]
    for record in ("EDGE2", "ODOMETRY"):
        text = "".join(f"{record} {ends} {z} {info}\n" for ends, z in rows)
        graph = read_text(tmp_path, text, "a.txt")
        assert graph.dialect == "isam"
        assert "read as isam text (square roots of the information)" in graph.notes[0]
        assert "--dialect slam++" in graph.notes[0]
        assert chi2(graph) == pytest.approx(223.6008818, rel=1e-8)
        said = read_text(tmp_path, text, "a.txt", "slam++")
        assert said.notes == ()
        assert chi2(said) == pytest.approx(0.7378989069, rel=1e-8)
        assert read_text(tmp_path, text, "a.txt", "isam").notes == ()
    vertices = "".join(f"VERTEX2 {k} {k} 0 0\n" for k in range(4))
    graph = read_text(tmp_path, vertices + "".join(f"EDGE2 {ends} {z} {info}\n" for ends, z in rows), "a.graph")
    assert graph.dialect == "slam++"
    assert "--dialect toro" in graph.notes[0]


@pytest.mark.parametrize("landmark", ["LANDMARK2", "LANDMARK2:XY", "LANDMARK"])
def test_slampp_has_the_names_of_g2o_too(tmp_path: Path, landmark: str) -> None:
    """As its parser has them: EDGE_SE2 is EDGE2, and EDGE_SE2_XY is LANDMARK."""
    text = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0.1 45 0 0 45 0 400\n"
    text += f"{landmark} 0 3 2 1 10 2 10\nEDGE_SE2_XY 1 3 1 1 10 2 10\n"
    if landmark == "LANDMARK":  # iSAM has it, too, and means square roots
        with pytest.raises(FormatError, match=r"--dialect slam\+\+, which has them all"):
            read_text(tmp_path, text)
        graph = read_text(tmp_path, text, dialect="slam++")
    else:
        graph = read_text(tmp_path, text)
    assert graph.dialect == "slam++"
    (landmarks,) = [group for group in graph.batch.factors if group.kind == "landmark_se2"]
    np.testing.assert_array_equal(landmarks.information, [[10, 2, 10]] * 2)


def test_a_record_of_slampp_among_those_of_g2o_is_said_with_what_it_is_taken_for(tmp_path: Path) -> None:
    """Vertices of points and FIX are read as g2o's, and the graph is that of the file in g2o's names."""
    text = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_XY 3 2.5 1\nFIX 1\nEDGE_SE2 0 1 1 0 0.1 45 0 0 45 0 400\n"
    text += "LANDMARK2 0 3 2 1 10 2 10\nLANDMARK2 1 3 1 1 10 2 10\n"
    read_text(tmp_path, text)
    graph = read(tmp_path / "a.g2o", strict=True)
    (note,) = graph.notes
    assert note.startswith("LANDMARK2 read beside EDGE_SE2, FIX, VERTEX_SE2, VERTEX_XY of g2o as slam++ has it: x y in")
    same = read_text(tmp_path, text.replace("LANDMARK2", "EDGE_SE2_XY"), "b.g2o")
    assert same.notes == ()
    assert str(graph.batch) == str(same.batch)
    left = read_text(tmp_path, text, dialect="g2o").left_out
    assert left == {"LANDMARK2": 2, "vertices": 1}
    assert read_text(tmp_path, "VERTEX2 0 0 0 0\n" + text.splitlines()[-2] + "\n").notes == ()


def test_edges_of_two_dialects_that_weigh_differently_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"a record of g2o and slam\+\+"):
        read_text(tmp_path, loop() + "EDGE2 0 2 2 0 0 45 1 1 45 1 400\n")


def test_what_only_one_bearing_sees_is_in_no_step(tmp_path: Path) -> None:
    graph = read_text(tmp_path, loop() + "VERTEX_XY 9 1 1\nEDGE_BEARING_SE2_XY 0 9 0.5 100\n")
    assert graph.left_out == {"points": 1}
    assert "bearings from a single pose do not place 9" in graph.notes[0]
    assert chi2(graph) == pytest.approx(LOOP_CHI2, rel=1e-8)
    assert graph.batch.variable_count == 5
