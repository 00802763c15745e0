"""The budget of a map's steps."""

# Of a map that is created, and of its journal's settings: milliseconds, from 0 (there is none) to a minute.
BUDGET_OPTION = "budget_ms"
BUDGET_SPAN_MS = (0.0, 60_000.0)
BUDGET_WANTED = "milliseconds from 0 (no bound) to 60000"
