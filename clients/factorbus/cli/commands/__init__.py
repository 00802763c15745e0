"""One file for each command of `factorbus`."""
