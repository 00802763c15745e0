"""Changes of a graph that are no additions: removing, weighing, marginalizing, repairing."""
