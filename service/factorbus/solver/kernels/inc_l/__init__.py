"""R in block rows, updated: the Ω-update and the Λ-update of the 2013 paper."""
