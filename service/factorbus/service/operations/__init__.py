"""What an operator meets: the start, the health report, the metrics."""
