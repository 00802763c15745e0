"""Time stamps of variables: int64 nanoseconds of the clock of the client that inserts them.

Nobody between the sender and the reader looks into one: which clock it is, and where that begins, is theirs to agree
on.  Time since 1970 is usual; 0 and what is before it are stamps as any other.
"""

# In a column, of a variable without one: the int64 that NumPy has for NaT.
NO_STAMP = -(2**63)
LEAST_STAMP, MOST_STAMP = NO_STAMP + 1, 2**63 - 1
