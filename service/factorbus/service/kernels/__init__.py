"""Compiled readers and writers of the messages around every insert.  `factorbus.proto.codec` is the reference."""
