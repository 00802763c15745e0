"""Files that were damaged on the way are read or refused with FormatError, never anything else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorbus.formats import FormatError, read
from factorbus.formats.parallax import lone_bearings
from factorbus.formats.ranging import lone_ranges

INFO3 = "1 0 0 1 0 1"
INFO6 = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
FILES = [
    "# plane\nVERTEX_SE2 0 0 0 0\nVERTEX_XY 3 1 1\nFIX 0\n"
    f"EDGE_SE2 0 1 1 0 0.5 {INFO3}\nEDGE_SE2 1 2 1 0 -0.5 {INFO3}\nEDGE_SE2_XY 2 3 1 2 1 0 1\n"
    f"EDGE_PRIOR_SE2 1 0 0 0 {INFO3}\n",
    f"PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 0 1 2 3 0 0 0 1\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFO6}\n"
    f"EDGE_SE3_TRACKXYZ 0 7 0 1 2 3 1 0 0 1 0 1\nEDGE_SE3_PRIOR 1 0 1 2 3 0 0 0 1 {INFO6}\n",
    "PARAMS_SE2OFFSET 0 0.1 0.2 0.3\nPARAMS_SE3OFFSET 1 0 0 1 0 0 0.6 0.8\n"
    "PARAMS_CAMERACALIB 2 0 0 0 0 0 0 1 500 500 320 240\nVERTEX_SE2 6989586621679009792 0 0 0\nVERTEX_SE2 1 1 0 0\n"
    f"EDGE_SE2 6989586621679009792 1 1 0 0.5 {INFO3} 1\nEDGE_SE2_OFFSET 1 2 0 0 1 0 0 {INFO3} # hm\n"
    f"EDGE_BEARING_SE2_XY 2 30 0.5 4\nEDGE_PRIOR_SE2_XY 1 10 10 1 0 1\nEDGE_PRIOR_XY 30 1 1 1 0 1\n"
    f"VERTEX_SWITCH 4 1\nEDGE_SWITCH_PRIOR 4 1 1\nEDGE_SE2_SWITCHABLE 1 2 4 0 0 0 {INFO3}\nROBOTLASER1 0 1 2\n"
    f"EDGE_SE2_MAXMIX 6989586621679009792 1 0.1 0 0 0 {INFO3}\nEDGE_SE3_XYZ_PRIOR 40 1 7 8 9 1 0 0 1 0 1\n"
    f"EDGE_SE3_OFFSET 40 41 1 1 1 0 0 0 0 0 1 {INFO6}\nEDGE_SE3_TRACKXYZ 40 50 2 1 2 3 1 0 0 1 0 1\n"
    "EDGE_POINTXYZ_PRIOR 41 1 2 3 1 0 0 1 0 1\nVERTEX_SE2 9 0 0 0\n",
    f"VERTEX2 0 0 0 0\nODOMETRY 0 1 1 0 0 {INFO3}\nLANDMARK2 1 5 5 6 1 0 1\n",
    "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\nEQUIV 0 1\nBR 0 5 0.1 2 0.1 0.1\n",
    f"ODOMETRY 0 1 1 0 0 {INFO3}\nLANDMARK 1 0 5 6 1 0 1\nEDGE3 5 6 1 2 3 0.1 0.2 0.3 {INFO6}\n",
    "VERTEX_SE2 0.5 A0 0 0 0\nVERTEX_SE2 1.5 A1 1 0 0\nVERTEX_SE2 1.5 B0 1 3 0\nVERTEX_XY L0 4 1\n"
    f"VERTEX_SE2:PRIOR 0.5 A0 0 0 0 {INFO3}\nEDGE_SE2 0.5 A0 A1 1 0 0 {INFO3}\nEDGE_SE2_XY 0.5 A0 L0 4 1 1 0 1\n"
    "EDGE_RANGE 0.5 A0 L0 4 1\nEDGE_RANGE 1.5 A1 B0 3 1\n",
    f"VERTEX_SE3:QUAT 0 A0 0 0 0 0 0 0 1\nVERTEX_XYZ L0 1 2 3\nEDGE_SE3:QUAT 0 A0 A1 1 0 0 0 0 0 1 {INFO6}\n"
    "EDGE_RANGE 0 A0 L0 4 1\n",
]
NUMBERS = [
    "0",
    "1",
    "-1",
    "2",
    "1e3",
    "1e200",
    "1e400",
    "-inf",
    "nan",
    "0x1",
    "1_0",
    "1.5",
    "+7",
    ".",
    "-",
    "e",
    "99999999999999999999999",
    "72057594037927935",
    "72057594037927936",
    "9223372036854775808",
]
NAMES = [
    "FIX",
    "EDGE2",
    "EDGE3",
    "EDGE_SE2",
    "VERTEX2",
    "EDGE_SE3:QUAT",
    "EDGE_SWITCH_PRIOR",
    "EDGE_SE2_MAXMIX",
    "PARAMS_SE3OFFSET",
    "VERTEX_XY",
    "\x00",
    "\u0661",
    "\ufeff",
    "#",
    "é",
]
WORDS = st.sampled_from(NUMBERS + NAMES)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """A good file after a few changes: words replaced, doubled or lost, lines cut, swapped or repeated, bytes."""
    lines = [line.split(" ") for line in draw(st.sampled_from(FILES)).splitlines()]
    for _ in range(draw(st.integers(1, 4))):
        row = draw(st.integers(0, len(lines) - 1))
        place = draw(st.integers(0, max(len(lines[row]) - 1, 0)))
        match draw(st.sampled_from(["replace", "insert", "drop", "repeat", "swap", "take"])):
            case "replace":
                lines[row][place : place + 1] = [draw(WORDS)]
            case "insert":
                lines[row].insert(place, draw(WORDS))
            case "drop":
                del lines[row][place : place + 1]
            case "repeat":
                lines.append(list(lines[row]))
            case "swap":
                other = draw(st.integers(0, len(lines) - 1))
                lines[row], lines[other] = lines[other], lines[row]
            case "take":
                lines[row] = lines[row][:place]
    content = "\n".join(" ".join(words) for words in lines).encode()
    if draw(st.booleans()) and content:
        place = draw(st.integers(0, len(content) - 1))
        content = content[:place] + draw(st.binary(max_size=3)) + content[place + draw(st.integers(0, 3)) :]
    return content


@settings(max_examples=400)
@given(content=damaged() | st.binary(max_size=60))
def test_damaged_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.g2o"
    path.write_bytes(content)
    problem = None
    try:
        graph = read(path)
        count = sum(step.factor_count for step in graph.steps())
    except FormatError as caught:
        problem = caught
    if problem is None:
        # In no step, with all that names them.
        lone = np.concatenate([lone_bearings(graph.batch), lone_ranges(graph.batch)])
        assert count == sum(int((~np.isin(g.keys, lone).any(axis=1)).sum()) for g in graph.batch.factors)
    else:
        assert problem.file == str(path)
        lines = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").count(b"\n") + 1
        assert problem.line is None or 1 <= problem.line <= lines
