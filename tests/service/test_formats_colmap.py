"""Poses of COLMAP's models, as text and binary."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.formats import FormatError, read
from factorbus.formats.rotations import rotation_matrices
from factorbus.proto.symbols import symbol

# Number, world to camera as qw qx qy qz tx ty tz, name.
IMAGES = [
    (4, (0.5, 0.5, -0.5, 0.5, 1.0, 2.0, 3.0), "b/1403636579763555584.png"),
    (2, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -5.0), "1403636579813555456.png"),
    (9, (0.8, 0.0, 0.6, 0.0, 0.25, 0.0, 1.0), "1403636579863555584.png"),
]
HEAD = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"


def text(images: list[tuple[int, tuple[float, ...], str]], seen: str = "2.5 3.5 -1 7 8 12") -> str:
    """Every other image sees nothing: its second line is empty."""
    lines = []
    for turn, (number, values, name) in enumerate(images):
        lines += [f"{number} {' '.join(map(str, values))} 1 {name}", seen if turn % 2 else ""]
    return HEAD + "\n".join(lines) + "\n"


def binary(images: list[tuple[int, tuple[float, ...], str]]) -> bytes:
    parts = [struct.pack("<Q", len(images))]
    for turn, (number, values, name) in enumerate(images):
        points = struct.pack("<ddq", 1.0, 2.0, -1) * turn
        parts.append(
            struct.pack("<I7dI", number, *values, 1) + name.encode() + b"\0" + struct.pack("<Q", turn) + points
        )
    return b"".join(parts)


@pytest.fixture(params=["images.txt", "images.bin", "folder"])
def model(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    name = "images.bin" if request.param == "folder" else request.param
    (tmp_path / name).write_bytes(text(IMAGES).encode() if name == "images.txt" else binary(IMAGES))
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    return tmp_path if request.param == "folder" else tmp_path / name


def test_poses_are_where_the_cameras_are(model: Path) -> None:
    graph = read(model)
    (group,) = graph.batch.variables
    assert (graph.dialect, group.kind, group.keys.tolist()) == ("colmap", "se3", [symbol("x", n) for n in (2, 4, 9)])
    assert group.values is not None
    assert group.stamps is not None
    for number, values, name in IMAGES:
        row = group.keys.tolist().index(symbol("x", number))
        w, x, y, z = values[:4]
        R = rotation_matrices(np.array([[0, 0, 0, x, y, z, w]]))[0]  # of world to camera
        np.testing.assert_allclose(group.values[row, :3], -R.T @ values[4:], atol=1e-15)
        np.testing.assert_allclose(rotation_matrices(group.values[row : row + 1])[0], R.T, atol=1e-15)
        assert group.stamps[row] == int(Path(name).stem)
    assert "the scale is COLMAP's" in graph.notes[0]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["1305031452.791720.png", "1305031452.8.png"], [1305031452791720000, 1305031452800000000]),
        (["frame1.png", "frame2.png"], None),
        (["1305031452.791720.png", "other.png"], None),
        (["00000001.png", "00000002.png"], None),
        (["9" * 19, "1" * 19], None),
        (["a name with blanks.png", ""], None),
    ],
)
def test_names_that_are_times_become_stamps(tmp_path: Path, names: list[str], stamps: list[int] | None) -> None:
    images = [(n + 1, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), name) for n, name in enumerate(names)]
    (tmp_path / "images.bin").write_bytes(binary(images))
    (group,) = read(tmp_path).batch.variables
    assert (None if group.stamps is None else group.stamps.tolist()) == stamps


@pytest.mark.parametrize(
    ("broken", "line"),
    [
        (HEAD, None),
        (text(IMAGES[:2]).replace("4 0.5", "x 0.5"), 3),
        (text(IMAGES[:2]).replace("4 0.5", "4 0.6"), 3),
        (text(IMAGES[:2]).replace("2 1.0", "4 1.0"), 5),
        (text(IMAGES[:2]).replace("2 1.0", "2 nan"), 5),
        (text(IMAGES[:2]).replace("2 1.0", "99999999999 1.0"), 5),
        (text(IMAGES[:1]).replace(" 1 b/1403636579763555584.png", ""), 3),
    ],
)
def test_what_is_no_image_is_refused_with_its_line(tmp_path: Path, broken: str, line: int | None) -> None:
    (tmp_path / "images.txt").write_text(broken)
    with pytest.raises(FormatError) as refused:
        read(tmp_path / "images.txt")
    assert refused.value.line == line


@pytest.mark.parametrize("end", range(0, len(binary(IMAGES)), 3))
def test_a_binary_file_that_is_cut_is_refused(tmp_path: Path, end: int) -> None:
    (tmp_path / "images.bin").write_bytes(binary(IMAGES)[:end])
    with pytest.raises(FormatError, match="it ends within image"):
        read(tmp_path / "images.bin")


@given(content=st.binary(max_size=200), name=st.sampled_from(["images.txt", "images.bin"]))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes, name: str) -> None:
    file = tmp_path_factory.mktemp("colmap") / name
    file.write_bytes(content)
    try:
        graph = read(file)
    except FormatError:
        return
    assert all(np.isfinite(group.values).all() for group in graph.batch.variables if group.values is not None)


def test_it_cannot_be_driven(model: Path) -> None:
    with pytest.raises(FormatError, match="a trajectory, which has no measurements"):
        read(model).steps()


def test_a_folder_without_a_model_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"images\.txt"):
        read(tmp_path, "colmap")
