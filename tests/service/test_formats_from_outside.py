"""Graph files in the forms that other tools write, whole: each opens, and every mode ends at the right optimum.

They are in `from_outside/`.  χ² is g2o's where it reads them; that of a mixture and of a switchable edge is SciPy's
(BFGS of Σ ρ from several starts); of a graph that contradicts nothing it is 0.
"""

from pathlib import Path

import pytest

from factorbus.formats import FormatError, read, write_g2o
from factorbus.solver import Options, Solver, solve_batch

FOLDER = Path(__file__).with_name("from_outside")
LOOP = 0.004921420012
MODES = ("bayes-tree", "inc-l", "inc-l-b10", "all-batch")

# χ² at the optimum; what the reader says, a part of each note
CASES: dict[str, tuple[float, tuple[str, ...]]] = {
    "bearing_only.g2o": (39.62495095, ()),
    # g2o ends at 2.334492698, with predictions that are no one's: see the test below.
    "cam.g2o": (0.00267980137, ("1 PARAMS_CAMERACALIB left out",)),
    "gtsam_symbols.g2o": (0.006274534633, ()),
    "id_labeled.g2o": (LOOP, ()),
    "id_ns.g2o": (LOOP, ("3 of 4 ids are below 2^56",)),
    "isolated_vertex.g2o": (LOOP, ("no edge names 9",)),
    "landmark_unseen_vertex.g2o": (LOOP, ("no edge names 20",)),
    "maxmix.g2o": (6.114062638, ("1 EDGE_SE2_MAXMIX read as the likelier component",)),
    "prior_xy.g2o": (121.8515497, ()),
    "robotlaser.g2o": (LOOP, ("1 ROBOTLASER1 left out",)),
    "rot180.g2o": (0.0, ()),
    "rtabmap_2d_form.g2o": (LOOP, ("4 EDGE_SE2 with a number behind the information",)),
    "slampp.txt": (223.600882, ("read as isam text",)),
    "slampp_as_g2o.g2o": (0.7378989069, ()),
    "slampp_odo.txt": (223.600882, ("read as isam text",)),
    "switch.g2o": (
        2.689880238,
        ("with the loss dcs", "1 VERTEX_SWITCH left out", "1 EDGE_SWITCH_PRIOR left out"),
    ),
    "tight_1e13.g2o": (0.0, ()),
    "trackxyz.g2o": (0.00258535361, ()),
    "trackxyz_id.g2o": (0.00267980137, ()),
    "trailing_comment.g2o": (LOOP, ()),
}

# From the values of the file a drive ends in another minimum: 3 % higher, of which `ask chi2 --batch` tells, and 0.1 %.
ELSEWHERE = {"maxmix.g2o": 6.301038, "switch.g2o": 2.6938786}


def test_every_file_is_a_case() -> None:
    assert sorted(path.name for path in FOLDER.iterdir()) == sorted(CASES)


@pytest.mark.parametrize("name", CASES)
def test_it_says_what_it_read_and_the_batch_optimum_is_right(name: str) -> None:
    right, notes = CASES[name]
    graph = read(FOLDER / name)
    assert len(graph.notes) == len(notes)
    for said, part in zip(graph.notes, notes, strict=True):
        assert part in said
    for use_values in (True, False):
        whole = graph.whole(use_values)
        assert solve_batch(whole.variables, whole.factors).chi2 == pytest.approx(right, rel=1e-8, abs=1e-12)
    if graph.left_out:
        with pytest.raises(FormatError, match="strict"):
            read(FOLDER / name, strict=True)


def test_what_g2o_makes_of_a_camera_and_an_offset_with_one_number_is_its_own(tmp_path: Path) -> None:
    """Both parameters of cam.g2o are number 0: g2o 2.3 keeps the camera and takes its memory for that of an offset.

    Of a point at (2, 1, 0) it predicts (0, 0, 0) from the origin; without the camera it ends where we end with it.
    """
    g2o = pytest.importorskip("g2opy")

    def chi2(text: str) -> tuple[float, float]:
        """At the file's values, and where g2o ends."""
        (tmp_path / "a.g2o").write_text(text)
        graph = g2o.SparseOptimizer()
        graph.set_algorithm(g2o.OptimizationAlgorithmLevenberg(g2o.BlockSolverX(g2o.LinearSolverEigenX())))
        graph.load(str(tmp_path / "a.g2o"))
        graph.initialize_optimization()
        graph.compute_active_errors()
        begins = graph.active_chi2()
        graph.optimize(50)
        graph.compute_active_errors()
        return begins, graph.active_chi2()

    text = (FOLDER / "cam.g2o").read_text()
    assert chi2(text) == pytest.approx((2**2 + 1 + 1.1**2 + 1, 2.334492698), rel=1e-8)
    alone = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("PARAMS_CAMERACALIB"))
    assert chi2(alone) == pytest.approx((0.1**2, CASES["cam.g2o"][0]), rel=1e-8)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("use_values", [False, True], ids=["odometry", "values"])
@pytest.mark.parametrize("name", CASES)
def test_every_mode_is_at_the_optimum_at_the_end_of_a_replay(name: str, use_values: bool, mode: str) -> None:
    solver = Solver(Options(mode=mode))
    for batch in read(FOLDER / name).steps(use_values):
        solver.stage(batch)
        report = solver.step()
        assert report.chi2 == pytest.approx(solver.chi2(), rel=1e-9, abs=1e-12)
    for _ in range(60):  # 43 for prior_xy.g2o, whose map is turned by three positions that contradict each other
        if not solver.unfinished:
            break
        solver.step()
    right = ELSEWHERE.get(name, CASES[name][0]) if use_values else CASES[name][0]
    assert solver.chi2() == pytest.approx(right, rel=1e-6, abs=1e-10)
    assert not solver.unfinished


@pytest.mark.parametrize("name", ["slampp.txt", "slampp_odo.txt"])
def test_the_dialect_that_is_named_decides(name: str) -> None:
    whole = read(FOLDER / name, "slam++").whole()
    assert solve_batch(whole.variables, whole.factors).chi2 == pytest.approx(0.7378989069, rel=1e-8)


@pytest.mark.parametrize("name", [name for name in CASES if name.endswith(".g2o")])
def test_what_goes_in_comes_out_with_its_ids_at_the_same_optimum(name: str, tmp_path: Path) -> None:
    graph = read(FOLDER / name)
    out = tmp_path / "out.g2o"
    said = write_g2o(out, graph.batch, ids="auto" if graph.numbering == "ids" else graph.numbering)
    again = read(out)
    without_loss = name == "switch.g2o"
    assert any("loss" in note for note in said) == without_loss
    ids = {line.split()[1] for line in (FOLDER / name).read_text().splitlines() if line.startswith("VERTEX_SE")}
    written = {line.split()[1] for line in out.read_text().splitlines() if line.startswith("VERTEX_SE")}
    named = {part for line in out.read_text().splitlines() if line.startswith("EDGE") for part in line.split()[1:3]}
    assert ids & named <= written
    whole = again.whole()
    right = 6.114062638 if without_loss else CASES[name][0]
    assert solve_batch(whole.variables, whole.factors).chi2 == pytest.approx(right, rel=1e-8, abs=1e-12)
