"""The solver of a map: inserts are parsed, applied in one step, and judged."""
