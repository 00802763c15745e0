"""A map at work: its core, its solver, its journal, and the thread that steps run on."""
