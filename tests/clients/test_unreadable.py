"""A file that cannot be read: which one, why, what was wanted, and what to do next."""

from pathlib import Path

import pytest

from factorbus.cli.logs.table import text_of
from factorbus.cli.output.exits import Stopped, input_file
from factorbus.formats import FormatError, read

REASONS = (
    (IsADirectoryError(21, "Is a directory"), "it is a folder: name a file in it"),
    (FileNotFoundError(2, "No such file or directory"), "look for its name with ls"),
    (NotADirectoryError(20, "Not a directory"), "look for its name with ls"),
    (PermissionError(13, "Permission denied"), "chmod a+r"),
    (OSError(5, "Input/output error"), "look whether its disk is there and sound"),
)


@pytest.mark.parametrize(("error", "mend"), REASONS)
def test_each_reader_says_why_and_what_to_do(
    error: OSError, mend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> bytes:
        raise error

    monkeypatch.setattr(Path, "read_bytes", fails)
    monkeypatch.setattr(Path, "read_text", fails)
    path = tmp_path / "graph.g2o"
    told = []
    with pytest.raises(FormatError) as of_graph:
        read(path)
    told.append(str(of_graph.value))
    with pytest.raises(FormatError) as of_table:
        text_of(path, "lines of numbers")
    told.append(str(of_table.value))
    with pytest.raises(Stopped) as of_command, input_file(path):
        path.read_bytes()
    told.append(str(of_command.value))
    for each in told:
        assert str(path) in each
        assert str(error.strerror) in each
        assert mend in each


def test_of_a_folder_it_is_said_which_ones_are_read(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"\(Is a directory\); wanted a readable g2o.*GLIM has saved, with graph.txt"):
        read(tmp_path)


def test_a_damaged_file_is_not_blamed_on_its_disk(tmp_path: Path) -> None:
    damaged = tmp_path / "graph.g2o"
    damaged.write_bytes(b"\x1f\x8b damaged")
    with pytest.raises(FormatError, match="cannot be read") as refused:
        read(damaged)
    assert "disk" not in str(refused.value)
