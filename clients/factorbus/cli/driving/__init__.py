"""A stream of inserts into a map, on the bus or in this process, and where it comes from."""
