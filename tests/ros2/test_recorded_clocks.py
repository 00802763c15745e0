"""Recordings whose sensors have clocks of their own, or whose messages came twice: what is not used is said."""

from pathlib import Path

import full_drive
import pytest
import recordings
import ros
import survey
from full_drive import FIX
from recordings import Said
from test_recordings import FOUND, same

from factorbus.ros2.messages import FIX as FIX_TYPE
from factorbus.ros2.messages import ODOMETRY
from factorbus.ros2.recorded_drive import read_recording

MADE = full_drive.full_drive(20)


def test_a_receiver_whose_clock_is_ahead_is_not_used_and_that_is_said(tmp_path: Path) -> None:
    """Its fixes waited for odometry that never came, and nobody heard of it."""
    late = MADE._replace(fixes=[(t + 7200.0, row) for t, row in MADE.fixes])
    made = read_recording(full_drive.write(tmp_path / "late.mcap", late), FOUND)
    assert not any(group.kind.startswith("position") for batch in made.steps for group in batch.factors)
    count, after = len(MADE.fixes), MADE.fixes[0][0] + 7200.0 - MADE.odometry[-1][0]
    assert f"{FIX}: {count} messages left out at the end, from {after:.4g} s after the last odometry on" in made.notes


def test_what_too_many_wait_behind_is_left_out_and_counted(tmp_path: Path) -> None:
    drive = survey.survey()
    odometry = [each for each in survey.said(drive, "", False) if each.type_name == ODOMETRY]
    ahead = 3600 * 10**9
    fixes = [
        Said("/gps/fix", FIX_TYPE, survey.at(0) + n, ros.nav_fix(survey.at(0) + ahead + n, drive.fixes[0]))
        for n in range(300)
    ]
    path = recordings.write_mcap(tmp_path / "many.mcap", [odometry[0], *fixes, *odometry[1:]])
    made = read_recording(path, FOUND)
    assert (made.used["/gps/fix"], made.left_out["/gps/fix"]) == (256, 44)
    (why,) = [note for note in made.notes if "44 messages not used" in note]
    assert "3600 s after the last odometry; wanted odometry of that time before 256 further messages wait" in why
    assert "are its stamps of the same clock?" in why


@pytest.mark.parametrize("kinds", [(FIX_TYPE,), (FIX_TYPE, ODOMETRY)])
def test_messages_that_came_twice_count_once(kinds: tuple[str, ...], tmp_path: Path) -> None:
    said = survey.said(survey.survey())
    once = read_recording(recordings.write_mcap(tmp_path / "once.mcap", said), FOUND)
    twice = [copy for each in said for copy in ([each, each] if each.type_name in kinds else [each])]
    made = read_recording(recordings.write_mcap(tmp_path / "twice.mcap", twice), FOUND)
    assert same(made, once)
    assert made.left_out["/gps/fix"] == survey.COUNT
    assert any("twice; wanted each fix once" in note for note in made.notes)
