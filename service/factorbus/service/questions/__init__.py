"""What may be asked of a map, and the answers, computed from one revision of it."""
