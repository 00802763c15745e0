"""Which factors that close loops are believed when they come, one after the other."""
