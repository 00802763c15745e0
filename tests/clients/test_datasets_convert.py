"""Sources of every form become the one form: by hand on small files, to the last bit on the real ones."""

import hashlib
import random
from contextlib import suppress
from pathlib import Path

import pytest
from dataset_sources import written_back
from hypothesis import given
from hypothesis import strategies as st

from factorbus.datasets import CATALOGUE, Dataset, convert, dataset_named
from factorbus.datasets.errors import BadSource
from factorbus.datasets.places import Places

ISAM = """\
ODOMETRY 0 1 1.50 -0.0 1e-3 3 0 0 4 0 44.72135955
EDGE2 0 2 7 7 7 2 1 0.5 3 0.25 4
LANDMARK 2 0 4.0 5.0 1.581139 0 1.581139
ODOMETRY 1 2 1 0 0 3 0 0 4 0 44.72135955
LANDMARK 0 1 +6 .5 10 2 10

"""

# By hand: RᵀR of (2 1 .5; 3 .25; 4) is 4, 2, 1, 1+9, .5+.75, .25+.0625+16; of (10 2; 10) it is 100, 20, 4+100.
# Tree 1 is seen at pose 0, so its line stands first.
ISAM_CONVERTED = """\
EDGE_SE2_XY 0 1 +6 .5 100 20 104
EDGE_SE2 0 2 1.50 -0.0 1e-3 9 0 0 16 0 2000
EDGE_SE2 2 3 1 0 0 9 0 0 16 0 2000
EDGE_SE2 0 3 7 7 7 4 2 1 10 1.25 16.3125
EDGE_SE2_XY 3 4 4.0 5.0 2.500000537 0 2.500000537
"""

TORO = """\
# poses
VERTEX2 0 0 0 0
VERTEX2 1 1.0 0 0
VERTEX 2 2 0 0.10
EDGE2 1 2 1 0 0 11 12 22 33 13 23
EQUIV 2 0
# loops
EDGE2 2 0 5 5 5 1 2 3 4 5 6
EDGE 1 0 -1 0 0 1.000000 0.0 1 2 0 0
"""

TORO_CONVERTED = """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.0 0 0
VERTEX_SE2 2 2 0 0.10
EDGE_SE2 1 0 -1 0 0 1.000000 0.0 0 1 0 2
EDGE_SE2 1 2 1 0 0 11 12 13 22 23 33
EDGE_SE2 2 0 5 5 5 1 2 5 3 6 4
"""

G2O = """\
VERTEX_SE2 1 1 0 0
VERTEX_SE2 0 0 0 0
VERTEX_SE2 2 2 0 0
FIX 0
EDGE_SE2 0 2 2 0 0  1 0 0 1 0 9
EDGE_SE2 2 0 3 0 0 1 0 0 1 0 8
EDGE_SE2 1 2 1 0 0 1 0 0 1 0 7\r
EDGE_SE2 0 1 1 0 0 1 0 0 1 0 6
"""

G2O_CONVERTED = """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
VERTEX_SE2 2 2 0 0
EDGE_SE2 0 1 1 0 0 1 0 0 1 0 6
EDGE_SE2 1 2 1 0 0 1 0 0 1 0 7
EDGE_SE2 0 2 2 0 0 1 0 0 1 0 9
EDGE_SE2 2 0 3 0 0 1 0 0 1 0 8
"""


@pytest.mark.parametrize(
    ("form", "source", "wanted"),
    [("isam", ISAM, ISAM_CONVERTED), ("toro", TORO, TORO_CONVERTED), ("g2o", G2O, G2O_CONVERTED)],
)
def test_small_sources_by_hand(form: str, source: str, wanted: str) -> None:
    assert convert(form, [("source", source.encode())]).decode() == wanted


def test_the_two_files_of_the_freiburg_exercises() -> None:
    vertices = ("killian-v.dat", b"vertex data\nVERTEX2 0 0.0 0.0 0.0\nVERTEX2 1 1.0 0.0 0.0\n")
    edges = ("killian-e.dat", b"Edge\nEDGE2 1 0 -1.0 0.0 0.0 20.0 0.0 21.0 100000.000 1.0 2.0\n")
    wanted = "VERTEX_SE2 0 0.0 0.0 0.0\nVERTEX_SE2 1 1.0 0.0 0.0\nEDGE_SE2 1 0 -1.0 0.0 0.0 20.0 0.0 1.0 21.0 2.0"
    assert convert("toro", [vertices, edges]).decode() == f"{wanted} 100000.000\n"


def test_covariances_go_by_way_of_the_rounded_root() -> None:
    source = b"ODOMETRY 0 1 1 2 3 0.0001 0 0 4e-06 0 4e-06\nLANDMARK 1 2 1 2 0.4 0 0.4\n"
    wanted = "EDGE_SE2 0 1 1 2 3 10000 0 0 250000 0 250000\nEDGE_SE2_XY 1 2 1 2 2.500000537 0 2.500000537\n"
    assert convert("isam_covariance", [("source", source)]).decode() == wanted


@pytest.mark.parametrize(
    ("form", "source", "line", "says"),
    [
        ("isam", "ODOMETRY 0 1 1 0 0 1 0 0 1 0\n", 1, "10 fields"),
        ("isam", "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\nEDGE3 0 1\n", 2, "unknown record"),
        ("isam", "ODOMETRY 0 -1 1 0 0 1 0 0 1 0 1\n", 1, "no number"),
        ("isam", "ODOMETRY 0 1 1 0 nan 1 0 0 1 0 1\n", 1, "no number"),
        ("isam", "ODOMETRY 0 1 1 0 1_0 1 0 0 1 0 1\n", 1, "no number"),
        ("isam", "ODOMETRY 3 3 1 0 0 1 0 0 1 0 1\n", 1, "to itself"),
        ("isam", "# nothing\n", None, "no edge"),
        ("isam_covariance", "LANDMARK 0 1 1 0 1 0.5 1\n", 1, "not diagonal"),
        ("isam_covariance", "LANDMARK 0 1 1 0 1 0 0\n", 1, "not above 0"),
        ("g2o", "VERTEX_SE2 7 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", None, "vertex 7 without an edge"),
        ("toro", "<!DOCTYPE html>\n", 1, "unknown record"),
        ("toro", "EDGE2 0 1 \xe9\n", 1, "not ASCII"),
    ],
)
def test_what_is_not_of_the_form_is_refused(form: str, source: str, line: int | None, says: str) -> None:
    with pytest.raises(BadSource, match=says) as refused:
        convert(form, [("source", source.encode())])
    assert refused.value.code == "bad_source"
    assert refused.value.detail["line"] == line


@given(st.binary(max_size=200) | st.text("EDG2 ODMTRY01.5e-\n", max_size=200).map(str.encode))
def test_no_bytes_make_it_fail_otherwise(content: bytes) -> None:
    for form in ("isam", "isam_covariance", "toro", "g2o"):
        with suppress(BadSource):
            assert convert(form, [("source", content)]).endswith(b"\n")


@pytest.mark.parametrize("name", ["manhattan3500", "city10000", "citytrees10000", "killian", "victoria_park"])
def test_real_sources_to_the_last_bit(datasets: Path, name: str) -> None:
    """The source written back has the source's own checksum, so it is the source; converted, it has the other one."""
    dataset = dataset_named(name, CATALOGUE)
    assert dataset.download is not None
    source = written_back(name, datasets)
    assert sha256(source) == dataset.download.sha256[0]
    assert sha256(convert(dataset.download.form, [(name, source)])) == dataset.sha256


@pytest.mark.parametrize("name", ["w10000_toro", "victoria_park"])
def test_what_the_gtsam_wheel_ships_to_the_last_bit(name: str) -> None:
    folder, dataset = Places.of_this_machine().wheel, dataset_named(name, CATALOGUE)
    if folder is None:
        pytest.skip("gtsam is not installed: pip install 'factorbus[bench]'")
    assert dataset.wheel is not None
    source = (folder / dataset.wheel.paths[0]).read_bytes()
    assert sha256(source) == dataset.wheel.sha256[0]
    assert sha256(convert(dataset.wheel.form, [(name, source)])) == dataset.sha256


@pytest.mark.data
@pytest.mark.parametrize("name", ["w10000", "intel", "sphere2500", "parking_garage", "killian_freiburg"])
def test_any_order_of_a_source_that_keeps_each_poses_own(datasets: Path, name: str) -> None:
    """The order of these sources is not known; whatever it is, the outcome is the same, and that of the catalogue."""
    dataset = dataset_named(name, CATALOGUE)
    assert dataset.download is not None
    source = shuffled((datasets / dataset.file).read_text().splitlines(), dataset.download.form, seed=3)
    assert sha256(convert(dataset.download.form, [(name, source)])) == dataset.sha256


@pytest.mark.parametrize("dataset", CATALOGUE, ids=lambda dataset: dataset.name)
def test_the_catalogue_counts_right(datasets: Path, dataset: Dataset) -> None:
    content = (datasets / dataset.file).read_bytes()
    rows = [line.split()[:3] for line in content.decode().splitlines()]
    edges = [row for row in rows if row[0] in ("EDGE_SE2", "EDGE_SE3:QUAT")]
    observations = [row for row in rows if row[0] == "EDGE_SE2_XY"]
    poses = {word for row in edges for word in row[1:]}
    assert sha256(content) == dataset.sha256
    assert (len(edges), len(observations)) == (dataset.edges, dataset.observations)
    assert (len(poses), len({row[2] for row in observations})) == (dataset.poses, dataset.landmarks)
    assert sum(row[0].startswith("VERTEX") for row in rows) == dataset.vertices
    assert any("SE3" in row[0] for row in rows) == (dataset.kind == "3D")


def shuffled(lines: list[str], form: str, seed: int) -> bytes:
    """A source: poses in a random order, vertices and edges mixed, the odometry edge at a random place in its pose."""
    rng = random.Random(seed)
    by_pose: dict[int, list[list[str]]] = {}
    mixed: list[list[list[str]]] = []
    for row in map(str.split, lines):
        if row[0].startswith("VERTEX"):
            mixed.append([row])
        else:
            by_pose.setdefault(max(int(row[1]), int(row[2])), []).append(row)
    for odometry, *others in by_pose.values():
        others.insert(first_place_after(others, odometry, rng), odometry)
        mixed.append(others)
    rng.shuffle(mixed)
    rows = [as_toro(row) if form == "toro" else row for group in mixed for row in group]
    return "".join(f"{' '.join(row)}\n" for row in rows).encode()


def first_place_after(others: list[list[str]], odometry: list[str], rng: random.Random) -> int:
    """A place for the odometry edge, before any other edge that joins the same two poses."""
    same = [k for k, row in enumerate(others) if {row[1], row[2]} == {odometry[1], odometry[2]}]
    return rng.randint(0, min(same, default=len(others)))


def as_toro(row: list[str]) -> list[str]:
    if row[0] == "VERTEX_SE2":
        return ["VERTEX2", *row[1:]]
    return ["EDGE2", *row[1:8], row[9], row[11], row[8], row[10]]


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
