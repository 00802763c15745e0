"""What a drive counts of its inserts."""

from factorbus.cli.driving.drive import Driven
from factorbus.client import Draft


def test_a_mount_is_no_pose_also_where_its_factor_comes_in_a_later_insert() -> None:
    driven, mount = Driven(), (0.1, 0, 0, 0, 0, 0, 1)
    first = Draft().se3("x0", (0, 0, 0, 0, 0, 0, 1), fixed=True).se3("m0", mount)
    first.prior_se3("m0", mount, sigmas=[0.1] * 6)
    driven.add(first.batch())
    for n in (1, 2):
        step = Draft().se3(f"x{n}")
        step.between_se3(f"x{n - 1}", f"x{n}", (1, 0, 0, 0, 0, 0, 1), mount="m0", sigmas=[0.1] * 6)
        driven.add(step.batch())
    assert driven.poses == 3


def test_the_maps_pose_in_another_frame_that_comes_with_its_factor_is_no_pose() -> None:
    driven = Driven()
    driven.add(Draft().se2("x0", (0, 0, 0), fixed=True).batch())
    fix = Draft().se2("f0", (0, 0, 0)).position_se2("x0", (1, 2), frame="f0", sigmas=[1.0, 1.0])
    driven.add(fix.batch())
    driven.add(Draft().position_se2("x0", (1, 2), frame="f0", sigmas=[1.0, 1.0]).batch())
    assert driven.poses == 1
