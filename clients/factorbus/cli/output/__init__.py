"""What a person reads: the console, exit codes, advice, tables."""
