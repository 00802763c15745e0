"""The process of a command: its options, its children, the bus, and how it stops."""
