"""The journal of a map: written beside the steps, and recovered from."""
