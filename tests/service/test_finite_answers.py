"""Of a map whose R is no use any more, covariances are refused by name, and no NaN goes out."""

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.proto import asking_codec
from factorbus.proto.asking import AskCovariance
from factorbus.proto.symbols import symbol
from factorbus.service.questions.answers import answer, parse, snapshot
from factorbus.service.questions.question_memory import Room
from factorbus.solver import Solver
from factorbus.solver.errors import NotFinite

X0, X1 = symbol("x", 0), symbol("x", 1)
ASKED = {
    "diagonal": AskCovariance("diagonal", np.array([X0, X1])),
    "joint": AskCovariance("joint", np.array([X0, X1])),
    "cross": AskCovariance("cross", np.array([X0]), np.array([X1])),
    "relative": AskCovariance("relative", np.array([[X0, X1]])),
    "last": AskCovariance("last"),
}


@pytest.mark.parametrize("blocks", ASKED)
def test_a_covariance_that_is_not_finite_is_refused_by_name(blocks: str) -> None:
    solver = Solver()
    draft = Draft().se2("x0").se2("x1").prior_se2("x0", (0, 0, 0), sigmas=(1, 1, 1))
    solver.stage(draft.between_se2("x0", "x1", (1, 0, 0), sigmas=(1, 1, 1)).batch())
    solver.step()
    question = parse("covariance", asking_codec.encode_ask_covariance(ASKED[blocks]))
    solver._stepper.tree.numbers[:] = np.nan
    with pytest.raises(NotFinite, match=r"the covariance of x[01]|a candidate") as refused:
        answer(question, snapshot(solver, 7, 1, [question], {}, None, Room()))
    assert refused.value.code == "not_finite"
