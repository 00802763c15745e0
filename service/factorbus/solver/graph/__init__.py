"""The factor graph as columns: what comes in is judged, given first values, and kept."""
