"""Interests: who follows a part of a map gets that part, at the rate that was asked for, on a channel of its own."""
