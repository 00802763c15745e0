"""A program of ours whose search for an optimum ends after one try of each start: impatient.py MODULE ARGUMENT...

Where a graph is hard, the real search ends too early after 500.
"""

import runpy
import sys

from factorbus.solver.starts import descent

if __name__ == "__main__":
    descent._MOST = descent._CHUNK = 1
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
