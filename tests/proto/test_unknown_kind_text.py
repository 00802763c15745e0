"""What is said of a kind that there is not: what was meant first, and no list that nobody reads."""

import pytest

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.problems import UnknownKind


@pytest.mark.parametrize("name", ["betwen_se2", "nothing_like_it"])
def test_of_many_kinds_few_are_listed(name: str) -> None:
    told = str(UnknownKind("draft", name, FACTOR_KINDS.names(name)))
    assert len(told) < 400
    assert "those that `factorbus kinds` lists" in told


def test_what_was_meant_comes_first() -> None:
    told = str(UnknownKind("draft", "betwen_se2", FACTOR_KINDS.names("betwen_se2")))
    assert told.index("did you mean 'between_se2'?") < told.index("wanted one of prior_se2, between_se2, ")


def test_of_vectors_that_are_too_long_the_limit_is_said() -> None:
    assert "'vector10' is not known here; vector9 is the largest; wanted" in str(
        UnknownKind("draft", "vector10", tuple(VARIABLE_KINDS))
    )
