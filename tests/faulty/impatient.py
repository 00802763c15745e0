"""A program of ours whose search for an optimum ends after one try of each start: impatient.py MODULE ARGUMENT...

Where a graph is hard, the real search ends too early after 500.
"""

import runpy
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from few_tries import give_up_after

if __name__ == "__main__":
    give_up_after(1, setattr)
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
