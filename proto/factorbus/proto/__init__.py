"""What travels on the bus: keys, messages, their bytes, and the problems they may be answered with.

Light on purpose (numpy and msgpack only): every client imports it.  The text for people and for other
languages is `proto/README.md`; the golden bytes are in `proto/vectors/`.
"""
