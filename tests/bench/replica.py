"""A robot drives while the link to its upstream is cut again and again: is anything lost, twice, or otherwise?

python tests/bench/replica.py                       10,000 poses, 100 cuts of 1 to 60 s: an hour and more
python tests/bench/replica.py --poses 1000 --cuts 10 --seconds 0.5 5
"""

import argparse
import signal
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from processes import processes
from replicas import MAP, Link, check_equal, drive_with_cuts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--cuts", type=int, default=100)
    parser.add_argument("--seconds", type=float, nargs=2, default=(1.0, 60.0), help="of a cut, at least and at most")
    parser.add_argument("--rate", type=float, default=10.0, help="inserts a second")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, processes(Path(folder)) as spawn:
        base_folder, robot_folder = Path(folder) / "base", Path(folder) / "robot"
        listen = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0")
        base = spawn(*listen, "--journal", str(base_folder), "--name", "base")
        (base_endpoint,) = base.ready()
        link = Link(base_endpoint)
        robot = spawn(
            *listen, "--journal", str(robot_folder), "--name", "robot1", "--create", MAP, "--upstream", link.endpoint
        )
        (robot_endpoint,) = robot.ready()
        try:
            figures = drive_with_cuts(
                robot_endpoint, base_endpoint, link, given.poses, given.cuts, tuple(given.seconds), given.rate
            )
        finally:
            link.relay.close()
        for each in (robot, base):
            each.signal(signal.SIGTERM)
            each.wait()
        size = check_equal(base_folder, robot_folder, given.poses)
    share = figures["carried_bytes"] / size
    print(f"{given.poses:,} poses, {given.cuts} cuts: nothing lost, nothing twice, equal to the bit")
    print(f"{figures['rebased']:.0f} rebases; {size / 1e6:.2f} MB of inserts, {share:.2f} times that over the link")


if __name__ == "__main__":
    main()
