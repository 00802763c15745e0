"""Processes that compute for services: they join the bus, say how much they can do at a time, and take jobs.

jobs     what each kind of job does: bytes in, bytes out
app      the process: the only file here that knows Zenoh
config   where to connect, how many at a time
"""
