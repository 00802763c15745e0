"""JRL files that were damaged on the way are read or refused with FormatError, never anything else."""

import copy
import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jrl_logs import A0, B0, PLANE, SPACE

from factorbus.formats import FormatError, read

DOCUMENTS = [json.loads(text) for text in (PLANE, SPACE)]
NAMES = [
    "Pose2", "Pose3", "Point3", "Scalar", "Vector", "BetweenFactorPose3", "RangeFactor3D", "PriorFactorPose2",
    "type", "key", "key1", "stamp", "x", "a", "b", "0", "measurements", "covariance", "", "\ud800", "é", "x" * 300,
]  # fmt: skip
LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from([0, 1, -1, 2, A0, B0, 2**63, 2**64, 10**400, 0.0, -0.0, 1e-320, 1e200, 1e308, 0.5, [], {}, [[]]]),
    st.sampled_from(NAMES),
    st.lists(st.sampled_from([0, 1, 0.5, None, "a"]), max_size=10),
)


def parts(value: Any) -> list[tuple[Any, Any]]:
    """(container, key) of everything in a document."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else []
    return [pair for key in keys for pair in ((value, key), *parts(value[key]))]


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """A good file after a few changes: values replaced, doubled, lost, swapped or renamed, and of bytes."""
    document = copy.deepcopy(draw(st.sampled_from(DOCUMENTS)))
    for _ in range(draw(st.integers(1, 4))):
        there = parts(document)
        if not there:
            break
        (of, key), (other, its) = draw(st.sampled_from(there)), draw(st.sampled_from(there))
        match draw(st.sampled_from(["replace", "take", "drop", "repeat", "rename"])):
            case "replace":
                of[key] = copy.deepcopy(draw(LEAVES))  # the strategy gives the same lists again
            case "take":
                of[key] = copy.deepcopy(other[its])
            case "drop":
                del of[key]
            case "repeat" if isinstance(of, list):
                of.append(copy.deepcopy(of[key]))
            case "rename" if isinstance(of, dict):
                of[draw(st.sampled_from(NAMES))] = of.pop(key)
            case _:
                pass
    content = json.dumps(document).encode()
    if draw(st.integers(0, 3)) == 0:
        place = draw(st.integers(0, len(content) - 1))
        content = content[:place] + draw(st.binary(max_size=3)) + content[place + draw(st.integers(0, 3)) :]
    return content


@settings(max_examples=400)
@given(content=damaged())
def test_damaged_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.jrl"
    path.write_bytes(content)
    problem = None
    try:
        graph = read(path)
        count = sum(step.factor_count for step in graph.steps())
    except FormatError as caught:
        problem = caught
    if problem is None:
        assert count <= graph.batch.factor_count
        assert graph.log is not None
        assert [len(of.stamps) for of in graph.log.labels] == [len(group.keys) for group in graph.batch.factors]
    else:
        assert problem.file == str(path)
        assert problem.line is None or 1 <= problem.line <= content.count(b"\n") + 1
        assert str(problem).isascii()
