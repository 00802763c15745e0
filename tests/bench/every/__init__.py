"""`bench every-step`: the quality of an estimate at every step of a drive, held against the batch optimum from there.

drives    what is replayed, by name: simulated worlds, public data sets, and hard ones: steps that turn much of a map
hard      those;  motion: drives in the plane and in space, and measurements made on them
judge     χ² at an estimate, and at the optimum that full passes reach from it;  oracle: the same by SciPy alone
follow    one drive by our solver, judged at every step, then left alone until it is done;  peer: one by iSAM2
rows      steps to rows;  verdicts: what the rows must show;  tables: for a person
"""
