"""Compiled readers and writers of the messages that every insert is made of.  `factorbus.proto.codec` is the reference."""
