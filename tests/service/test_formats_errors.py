"""Every way in which a file is wrong names the file, the line, what stands there and what was wanted."""

import bz2
import gzip
import lzma
import os
import threading
import time
from pathlib import Path

import pytest

from factorbus.formats import FormatError, read

INFO3 = "1 0 0 1 0 1"
INFO6 = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
GOOD = f"EDGE_SE2 0 1 1 0 0 {INFO3}\n"

WRONG = {
    "unknown record alone": ("HELLO 1 2\n", 1, "unknown record 'HELLO'"),
    "3D SLAM++": ("LANDMARK2 0 1 1 1 1 0 1\nEDGE3 0 1 1 1\n", 2, "convert the file to g2o"),
    "3D TORO": ("VERTEX3 0 0 0 0 0 0 0\n", 1, "convert the file to g2o"),
    "too few fields": (f"{GOOD}EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", 2, "10 fields; wanted 11"),
    "too many fields": (f"{GOOD}# hm\nEDGE_SE2 0 1 1 0 0 {INFO3} 1 1\n", 3, "13 fields; wanted 11"),
    "no fields": (f"{GOOD}EDGE_SE2\n", 2, "0 fields; wanted 11"),
    "fields that even out": (f"EDGE_SE2 0 1 1 0 0 1 0 0 1 0\nEDGE_SE2 1 2 1 0 0 {INFO3} 1\n", 1, "10 fields"),
    "not a number": (f"{GOOD}EDGE_SE2 1 2 one 0 0 {INFO3}\n", 2, "'one'"),
    "two numbers in one": (f"{GOOD}EDGE_SE2 1 2 1-2 0 0 {INFO3}\n", 2, "'1-2'"),
    "underscore": (f"EDGE_SE2 1 2 1_0 0 0 {INFO3}\n", 1, "'1_0'"),
    "comma": (f"{GOOD}{GOOD}EDGE_SE2 1 2 1,5 0 0 {INFO3}\n", 3, "'1,5'"),
    "nan": (f"{GOOD}EDGE_SE2 1 2 nan 0 0 {INFO3}\n", 2, "not finite"),
    "infinite": (f"{GOOD}VERTEX_SE2 1 0 inf 0\n", 2, "not finite"),
    "overflow": (f"{GOOD}EDGE_SE2 1 2 1e999 0 0 {INFO3}\n", 2, "not finite"),
    "id is not whole": (f"{GOOD}EDGE_SE2 1 2.5 1 0 0 {INFO3}\n", 2, "id '2.5'"),
    "id below 0": (f"{GOOD}EDGE_SE2 -1 2 1 0 0 {INFO3}\n", 2, "id '-1'"),
    "id too large": (f"{GOOD}EDGE_SE2 1 9223372036854775808 1 0 0 {INFO3}\n", 2, "id '9223372036854775808'"),
    "id of twenty digits": (
        f"{GOOD}EDGE_SE2 1 18446744073709551616 1 0 0 {INFO3}\n",
        2,
        "from 0 to 9223372036854775807",
    ),
    "one key for a pose and a point": (
        f"EDGE_SE2 0 72057594037927936 1 0 0 {INFO3}\nEDGE_SE2_XY 0 72057594037927936 1 1 1 0 1\n",
        2,
        "72057594037927936 as a 2D point, which is a 2D pose on line 1",
    ),
    "infinity as MSVC prints it": ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 1.#INF\n", 2, "'1.#INF'"),
    "undefined as MSVC prints it": (f"{GOOD}EDGE_SE2 1 2 -1.#IND00 0 0 {INFO3}\n", 2, "'-1.#IND00'"),
    "number that is none, as MSVC prints it": (f"{GOOD}EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1.#QNAN\n", 2, "'1.#QNAN'"),
    "comment in the middle": (f"{GOOD}EDGE_SE2 0 1 1 # 0 0 {INFO3}\n", 2, "3 fields; wanted 11"),
    "switch with weight 0": (f"{GOOD}EDGE_SWITCH_PRIOR 4 1 0\n", 2, "information above 0"),
    "mixture with weight below 0": (f"{GOOD}EDGE_SE2_MAXMIX 0 1 -1 1 0 0 {INFO3}\n", 2, "with the weight -1"),
    "camera that is broken": ("PARAMS_CAMERACALIB 0 1 2\nEDGE_SE3_TRACKXYZ 0 1 0 1 2 3 1 0 0 1 0 1\n", 1, "3 fields"),
    "offset twice": (
        f"PARAMS_SE2OFFSET 0 0 0 0\nPARAMS_SE2OFFSET 0 0 0 1\n{GOOD}",
        2,
        "PARAMS_SE2OFFSET 0 again, with other numbers",
    ),
    "offset of the plane missing": (f"{GOOD}EDGE_SE2_POINTXY_OFFSET 0 9 3 1 1 1 0 1\n", 2, "PARAMS_SE2OFFSET 3 0 0 0"),
    "indefinite": (f"{GOOD}EDGE_SE2 1 2 1 0 0 1 2 0 1 0 1\n", 2, "not positive definite (smallest eigenvalue -1)"),
    "zero information": (f"{GOOD}EDGE_SE2 1 2 1 0 0 0 0 0 0 0 0\n", 2, "not positive definite"),
    "indefinite in space": (f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFO6[:-1]}-1\n", 1, "not positive definite"),
    "singular root": ("ODOMETRY 0 1 1 0 0 1 0 0 1 0 0\n", 1, "not positive definite"),
    "root too large": ("ODOMETRY 0 1 1 0 0 1e200 0 0 1 0 1\n", 1, "not positive definite"),
    "quaternion": (f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.5 0.5 {INFO6}\n", 1, "quaternion of norm 0.707107"),
    "zero quaternion": ("VERTEX_SE3:QUAT 0 1 0 0 0 0 0 0\n", 1, "quaternion of norm 0"),
    "self-loop": (f"{GOOD}EDGE_SE2 3 3 1 0 0 {INFO3}\n", 2, "from 3 to itself"),
    "vertex twice": (f"VERTEX_SE2 0 0 0 0\n{GOOD}VERTEX_SE2 0 0 1 0\n", 3, "other values than on line 1"),
    "pose and point": (f"{GOOD}EDGE_SE2_XY 0 1 1 1 1 0 1\n", 2, "1 as a 2D point, which is a 2D pose on line 1"),
    "plane and space": (f"{GOOD}EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1 {INFO6}\n", 2, "which is a 2D pose on line 1"),
    "FIX of nothing": (f"{GOOD}FIX 7\n", 2, "FIX 7, which is no vertex"),
    "FIX without id": (f"{GOOD}FIX\n", 2, "FIX with 0 fields"),
    "FIX alone": ("FIX 0\n", 1, "which is no vertex"),
    "FIX of two": ("VERTEX_SE2 0 0 0 0\nVERTEX_XY 0 1 1\nFIX 0\n", 3, "a pose and a point"),
    "offset missing": ("EDGE_SE3_TRACKXYZ 0 1 3 1 2 3 1 0 0 1 0 1\n", 1, "parameter 3, which no line declares"),
    "sigma": ("BR 0 1 0.1 4 0 1\n", 1, "standard deviations"),
    "range": ("BR 0 1 0.1 -4 1 1\n", 1, "range -4"),
    "records of TORO and g2o": (
        f"EQUIV 0 1\n{GOOD}",
        2,
        "EDGE_SE2, a record of g2o and slam++, in what is read as toro text",
    ),
    "records of g2o and iSAM": (f"{GOOD}ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n", 1, "--dialect slam++, which has them all"),
    "zero byte": (f"{GOOD}EDGE_SE2 0 1 1 0 0 1\x00\n", 2, "a zero byte"),
}


@pytest.mark.parametrize("case", WRONG)
def test_error_names_file_and_line(tmp_path: Path, case: str) -> None:
    text, line, words = WRONG[case]
    path = tmp_path / "wrong.g2o"
    path.write_bytes(text.encode())
    with pytest.raises(FormatError) as caught:
        read(path)
    problem = caught.value
    assert (problem.code, problem.file, problem.line) == ("bad_file", str(path), line)
    assert str(problem).startswith(f"{path}:{line}: ")
    assert words in str(problem)
    assert "; wanted " in str(problem)
    assert problem.detail == {"file": str(path), "line": line, "seen": problem.found, "wanted": problem.wanted}


def test_first_wrong_line_of_several_is_named(tmp_path: Path) -> None:
    path = tmp_path / "wrong.g2o"
    bad = "EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1\n"
    path.write_text(GOOD * 3 + bad + GOOD + bad)
    with pytest.raises(FormatError, match=":4: "):
        read(path)


@pytest.mark.parametrize("content", [b"", b"\n\n  \n", b"# only words\n"])
def test_empty_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "empty.g2o"
    path.write_bytes(content)
    with pytest.raises(FormatError, match="no record at all"):
        read(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="No such file"):
        read(tmp_path / "nowhere.g2o")
    with pytest.raises(FormatError, match="cannot be read"):
        read(tmp_path)


@pytest.mark.parametrize("packed", [False, True])
def test_a_pipe_is_read_whole(tmp_path: Path, packed: bool) -> None:
    pipe = tmp_path / "pipe.g2o"
    os.mkfifo(pipe)
    content = gzip.compress(GOOD.encode()) if packed else GOOD.encode()
    writer = threading.Thread(target=pipe.write_bytes, args=(content,), daemon=True)
    writer.start()
    assert read(pipe).batch.factor_count == 1
    writer.join(10)


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null"])
def test_a_device_is_refused_and_not_read_for_ever(device: str) -> None:
    with pytest.raises(FormatError, match=f"{device}: a device; wanted a file, or a pipe"):
        read(device)


def test_damaged_gzip(tmp_path: Path) -> None:
    whole = gzip.compress(GOOD.encode() * 50)
    for content in (whole[:-9], whole[:20], whole[:12] + b"\xff\xff" + whole[14:]):
        path = tmp_path / "damaged.g2o.gz"
        path.write_bytes(content)
        with pytest.raises(FormatError, match="cannot be read"):
            read(path)


def test_gzip_that_unpacks_to_very_much_more_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "blank.g2o.gz"
    path.write_bytes(gzip.compress(GOOD.encode() + b"\n" * 70_000_000, compresslevel=9))
    with pytest.raises(FormatError, match=r"blank\.g2o\.gz: gzip that unpacks to more than 200 times its"):
        read(path)


def test_blank_lines_take_no_time_and_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "blank.g2o"
    path.write_bytes(b" \n" + GOOD.encode() + b"\n \r\n" * 5_000_000 + b"  HELLO 1\n\n")
    begun = time.process_time()
    with pytest.raises(FormatError, match=r"blank\.g2o:10000003: HELLO"):
        read(path, strict=True)
    assert time.process_time() - begun < 3  # line by line 10 s


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (bz2.compress(GOOD.encode() * 50), "packed by bzip2; .*bunzip2"),
        (lzma.compress(GOOD.encode() * 50), "packed by xz; .*unxz"),
        (GOOD.encode("utf-16"), "text in UTF-16; .*iconv"),
        (b"PK\x03\x04\x14\x00", "a zip archive; .*unzip"),
        (b"\x00BZh", ":1: a zero byte"),
    ],
    ids=["bzip2", "xz", "UTF-16", "zip", "neither"],
)
def test_what_is_no_text_says_what_it_is(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "packed.g2o"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=said):
        read(path)


def test_unknown_dialect(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(GOOD)
    with pytest.raises(FormatError, match=r"dialect 'g3o'; wanted one of g2o, toro, isam, slam\+\+"):
        read(path, "g3o")


def test_a_named_dialect_reads_its_own_records(tmp_path: Path) -> None:
    path = tmp_path / "mixed.g2o"
    path.write_text(f"EQUIV 0 1\n{GOOD}")
    graph = read(path, "g2o")
    assert (graph.poses, graph.batch.factor_count, graph.left_out) == (2, 1, {"EQUIV": 1})
