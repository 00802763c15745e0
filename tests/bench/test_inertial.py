"""`factorbus bench inertial`: the beginning of a drive, and what it is held against."""

import pytest
from bench.drives_with_imu import DRIVES, drive_of
from bench.inertial import measured, missed


@pytest.mark.parametrize("name", DRIVES)
def test_the_beginning_of_a_drive_is_at_its_optimum_and_where_isam2_has_it(name: str) -> None:
    drive = drive_of(name, 21)
    ours, theirs = measured(drive, "factorbus", 10), measured(drive, "isam2", 20)
    assert ours["steps"] == drive.steps
    assert ours["chi2_ratio"] < 1.001
    assert ours["error_m"] <= 1.01 * theirs["error_m"] + 1e-3
    assert set(ours) == set(theirs)


def test_what_is_missed_is_said() -> None:
    row = {"dataset": "d", "solver": "factorbus", "cpu_s": 0.2, "error_m": 1.0, "chi2_ratio": 1.0}
    peer = row | {"solver": "isam2", "cpu_s": 1.0}
    assert missed([row, peer]) == []
    slow = row | {"cpu_s": 0.5, "error_m": 1.1, "chi2_ratio": 1.01}
    assert [each.split(":")[0] for each in missed([slow, peer])] == ["d"] * 3
