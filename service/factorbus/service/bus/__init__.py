"""The service on the bus: the one file that touches Zenoh, its configuration, and who may do what."""
