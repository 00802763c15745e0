"""How long a client's tiny insert waits while another one changes the same large map again and again.

    python tests/bench/changes.py [--poses 20000] [--changes 150] [--folder DIR] [--json]

A service with a journal has the simulated Manhattan, all of it inserted at once.  One client sends that many changes
without waiting, each a loss for one factor that closes a loop; the other then sends one tiny insert after the other.
The times are from sending to the answer, by the clock.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from processes import processes

from factorbus.client import Changes, Draft, connect
from factorbus.client.map import Map
from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan

_INSERTS = 3  # of the bystander in the burst


def run(poses: int, changes: int, folder: Path) -> dict[str, Any]:
    """Seconds of the bystander's inserts before and in the burst, and of the burst."""
    journal = folder / "journal"
    with processes(folder) as start:
        service = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(journal))
        endpoint = service.ready()[0]
        with (
            connect(endpoint, client="changer", timeout_s=600) as one,
            connect(endpoint, client="other", timeout_s=600) as two,
        ):
            changer = one.map("large", window=changes, mirror=False)
            loops = fill(changer, poses)
            other = two.map("large", create=False, mirror=False)
            quiet = [_tiny(other, n) for n in range(_INSERTS)]
            begun, before = time.perf_counter(), changer.stats()
            pending_inserts = [
                changer.send(Batch(), changes=Changes().loss([int(factor)], "huber", 1.5))
                for factor in np.resize(loops, changes)
            ]
            sent_s = time.perf_counter() - begun
            busy = [_tiny(other, _INSERTS + n) for n in range(_INSERTS)]
            for pending_insert in pending_inserts:
                pending_insert.result(600)
            burst_s = time.perf_counter() - begun
            after = changer.stats()
        largest = max((path.stat().st_size for path in journal.rglob("checkpoint-*.fbs")), default=0)
    return {
        "poses": poses,
        "changes": changes,
        "quiet_s": [round(each, 4) for each in quiet],
        "sent_s": round(sent_s, 3),
        "in_burst_s": [round(each, 4) for each in busy],
        "burst_s": round(burst_s, 2),
        "solver_cpu_s": round(after["solver_cpu_s"] - before["solver_cpu_s"], 2),
        "checkpoint_mb": round(largest / 1e6, 1),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def fill(joined: Map, poses: int) -> list[int]:
    """Insert a drive at once; gives the factors that close its loops."""
    variables, factors, loops, count = [], [], list[int](), 0
    for step in manhattan(poses, 1):
        variables += step.batch.variables
        factors += step.batch.factors
    draft = Batch(tuple(_together(variables)), tuple(_together(factors)))
    first = joined.insert(draft, settle=True, timeout_s=600).first_factor
    for group in draft.factors:
        if group.keys.shape[1] > 1:
            closes = np.abs(group.keys[:, 1] - group.keys[:, 0]) > 1
            loops += (first + count + np.flatnonzero(closes)).tolist()
        count += len(group.keys)
    return loops


def _together(groups: list[Any]) -> list[Any]:
    """Groups of the same sort as one."""
    found: dict[tuple[Any, ...], list[Any]] = {}
    for group in groups:
        sort = (
            group.kind,
            getattr(group, "fixed", ""),
            getattr(group, "loss", ""),
            getattr(group, "values", 0) is None,
        )
        found.setdefault(sort, []).append(group)
    made = []
    for some in found.values():
        columns = {
            name: np.concatenate([getattr(each, name) for each in some])
            for name in ("keys", "values", "measured", "information", "scale")
            if isinstance(getattr(some[0], name, None), np.ndarray)
        }
        made.append(some[0]._replace(**columns))
    return made


def _tiny(joined: Map, number: int) -> float:
    """Seconds of one insert, a pose beside the first one."""
    draft = Draft().se2(f"t{number}").between_se2("x0", f"t{number}", (0.1, 0, 0), sigmas=(0.1, 0.1, 0.05))
    begun = time.perf_counter()
    joined.insert(draft, timeout_s=600)
    return time.perf_counter() - begun


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--poses", type=int, default=20_000)
    parser.add_argument("--changes", type=int, default=150)
    parser.add_argument("--folder", type=Path, help="where the journal goes; its disk is what counts")
    parser.add_argument("--json", action="store_true", help="one document and nothing else")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        found = run(options.poses, options.changes, Path(folder))
    if options.json:
        print(json.dumps(found, indent=1))
        return
    print(f"{found['poses']} poses, a journal; {found['changes']} changes sent in {found['sent_s']} s")
    print(f"  tiny insert before the burst    {found['quiet_s']} s")
    print(f"  tiny insert in the burst        {found['in_burst_s']} s")
    print(f"  all changes answered after      {found['burst_s']} s, {found['solver_cpu_s']} s of a core")
    print(f"  largest checkpoint                {found['checkpoint_mb']} MB;  load {found['load']:.1f}")


if __name__ == "__main__":
    main()
