"""The process: its memory, its threads, whether it is alive."""
