"""Which variables are of which kind: spans that follow a graph as it grows and forgets, against counting anew."""

import numpy as np
import pytest

from factorbus.solver.kernels import layout as at
from factorbus.solver.rows import Rows


def labelled(labels: list[int]) -> np.ndarray:
    """`var` of variables with these labels, three numbers each."""
    var = np.zeros((max(len(labels), 1), at.V_WIDTH), np.int64)
    for v, label in enumerate(labels):
        var[v, at.V_KIND], var[v, at.V_AT], var[v, at.V_COLUMN] = label // 2, 3 * v, -1 if label % 2 else v
    return var


def check(rows: Rows, labels: list[int]) -> None:
    spans = list(rows.follow(labelled(labels), len(labels)))
    found = [(span.label, span.rows().tolist(), span.together) for span in spans]
    wanted = [(label, [v for v, one in enumerate(labels) if one == label]) for label in sorted(set(labels))]
    assert [one[:2] for one in found] == wanted
    for span, (_, there) in zip(spans, wanted, strict=True):
        if there[-1] - there[0] + 1 == len(there):
            assert not span.together or (span.first, span.behind, span.start) == (there[0], there[-1] + 1, 3 * there[0])
        else:
            assert not span.together


@pytest.mark.parametrize("seed", range(30))
def test_spans_are_what_counting_anew_gives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, labels = Rows(), list[int]()
    kinds = rng.choice(10, rng.integers(1, 4), replace=False)
    for _ in range(40):
        if labels and rng.random() < 0.3:
            del labels[int(rng.integers(0, len(labels) + 1)) :]
            rows.forget(len(labels))
        one = rng.random() < 0.5
        some = rng.choice(kinds[:1] if one else kinds, rng.integers(0, 14 if rng.random() < 0.3 else 3))
        labels += some.tolist()
        if rng.random() < 0.8:
            check(rows, labels)
    check(rows, labels)


def test_a_drive_stays_together_behind_its_fixed_start() -> None:
    rows, labels = Rows(), [1]
    for _ in range(50):
        labels.append(0)
        check(rows, labels)
    assert [span.together for span in rows.follow(labelled(labels), len(labels))] == [True, True]
