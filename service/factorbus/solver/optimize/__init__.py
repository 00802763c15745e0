"""Gauss-Newton and Levenberg-Marquardt on the whole graph, and when a minimization stops."""
