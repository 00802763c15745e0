"""Options that a journal has: those that a solver here does not know, or whose values it does not take, are named."""

import pytest

from factorbus.journal.problems import JournalOption
from factorbus.service.config import Limits
from factorbus.service.journal.library import make_map_solver
from factorbus.solver import Options, Tuning


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("chi2_epsilon", -1.0, "wanted a number, 0 or more"),
        ("max_rounds", 2.5, "wanted a whole number"),
        ("wildfire_treshold", 0.01, "did you mean 'wildfire_threshold'?"),
        ("clock", 1, "there is no such option here"),
    ],
)
def test_what_is_no_option_or_no_value_of_it_is_refused_by_name(name: str, value: object, says: str) -> None:
    with pytest.raises(JournalOption, match=name) as refused:
        make_map_solver("auto", {name: value}, 1, Limits())
    assert says in str(refused.value)


def test_options_and_tuning_of_a_journal_are_those_of_the_solver() -> None:
    told = Options(max_rounds=4, tuning=Tuning(chi2_epsilon=1e-9)).as_dict()
    settings = {name: value for name, value in told.items() if name != "mode"}
    assert make_map_solver("inc-l", settings, 1, Limits()).options() == {**told, "mode": "inc-l"}
