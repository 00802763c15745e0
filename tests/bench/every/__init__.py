"""`bench every-step`: the quality of an estimate at every step of a drive, held against the batch optimum from there.

judge     χ² at an estimate, and at the optimum that full passes reach from it
drives    what is replayed: simulated worlds, public data sets, and steps that turn much of a map
hard      the last kind
follow    one drive by our solver, judged at every step, then left alone until it is done
rows      steps to rows;  verdicts: what the rows must show
"""
