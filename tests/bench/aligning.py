"""Two maps into one frame, of candidates of which most are false: how often that is right, wrong, or left open.

    factorbus bench aligning [--draws N] [--seed S] [--json]

Each draw is two robots in a town drawn anew (`two_maps`); seeds are printed.  Worlds:

    plane, space   twelve right candidates, and eighteen false ones anywhere
    few            four right ones and six false ones
    alike          twelve right ones, and nine that agree on another frame, as where two places look alike
    nothing        thirty false ones
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from two_maps import as_matrices, solved, two_drives

from factorbus.client.alignment import ALIGNED, AMBIGUOUS, TOO_FEW, judge, log_of

POSES = 120
# Kind; right ones, false ones, grouped ones; what is right to say.
WORLDS = {
    "plane": ("se2", 12, 18, 0, ALIGNED),
    "space": ("se3", 12, 18, 0, ALIGNED),
    "few": ("se2", 4, 6, 0, ALIGNED),
    "alike": ("se2", 12, 0, 9, AMBIGUOUS),
    "nothing": ("se2", 0, 30, 0, TOO_FEW),
}
_FAR_SIGMAS = 5.0


def main() -> int:
    """Draw and tell; the exit code is 1 where any frame is wrong, or fewer than 99 % are as they should be."""
    parser = argparse.ArgumentParser(prog="factorbus bench aligning", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--draws", type=int, default=200, help="of each world")
    parser.add_argument("--seed", type=int, help="the first seed; without, another one each time")
    parser.add_argument("--only", default=",".join(WORLDS), help="WORLD,...")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    told = parser.parse_args()
    first = int(np.random.default_rng().integers(2**31)) if told.seed is None else told.seed
    rows: list[dict[str, Any]] = []
    for world in told.only.split(","):
        rows.append(row_of(world, first, told.draws))
        if not told.json:
            print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if told.json:
        print(json.dumps({"rows": rows}))
    return 0 if all(row["wrong"] == 0 and row["as_wanted"] >= 0.99 for row in rows) else 1


def row_of(world: str, first: int, draws: int) -> dict[str, Any]:
    """What came of all draws of one world.  wrong: believed, and more than five standard deviations off."""
    found = [draw(world, first + n) for n in range(draws)]
    verdicts = [verdict for verdict, *_ in found]
    return {
        "world": world, "seeds": f"{first}..{first + draws - 1}", "wanted": WORLDS[world][-1],
        "as_wanted": verdicts.count(WORLDS[world][-1]) / draws,
        **{verdict: verdicts.count(verdict) for verdict in (ALIGNED, AMBIGUOUS, TOO_FEW)},
        "wrong": sum(off > _FAR_SIGMAS for verdict, off, _ in found if verdict == ALIGNED),
        "nees": round(float(np.mean([off**2 for verdict, off, _ in found if verdict == ALIGNED] or [np.nan])), 2),
        "recall": round(float(np.mean([share for *_, share in found])), 4),
    }  # fmt: skip


def draw(world: str, seed: int) -> tuple[str, float, float]:
    """The verdict; how far the frame is off, in standard deviations (√d²); the share of right ones in the set."""
    rng = np.random.default_rng(seed)
    kind, right, wrong, grouped, _ = WORLDS[world]
    one, other, given = two_drives(kind, POSES, (right, wrong), grouped, rng)
    maps = solved(one.steps), solved(other.steps)
    judged = judge(as_matrices(kind, *maps, given))
    if judged.best is None:
        return judged.verdict, np.inf, 0.0
    reference = given[judged.best.reference]
    a, b = (of.truth[at] for of, at in ((one, reference.a), (other, reference.b)))
    known = as_matrices(kind, *maps, [reference])
    found = np.linalg.inv(known.a[0]) @ judged.best.T @ known.b[0]
    gap = log_of(np.linalg.inv(found) @ np.linalg.inv(a) @ b)
    off = float(np.sqrt(gap @ np.linalg.solve(judged.best.covariance, gap)))
    true = [k for k, each in enumerate(given) if each.is_right]
    return judged.verdict, off, float(np.isin(true, judged.best.members).mean()) if true else 1.0


if __name__ == "__main__":
    sys.exit(main())
