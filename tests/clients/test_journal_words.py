"""What `factorbus journal show` has in its cells: words, and no values as Python writes them."""

from factorbus.cli.commands.journal import _in_words


def test_values_are_written_for_a_person() -> None:
    assert [_in_words(value) for value in (True, False, [], "", [3, 5])] == ["yes", "no", "none", "none", "3, 5"]
    builds = [{"from_record": 1, "python": "3.11"}, {"from_record": 9, "python": "3.12"}]
    assert _in_words(builds) == "from_record 1, python 3.11; from_record 9, python 3.12"
