"""Replays of SLAM problems, pose by pose, by this solver and by others: the machinery of `bench paper`.

problems    what is replayed: data sets, or simulated worlds where there are none
columns     a replay as arrays;  chi2: one evaluator for the estimates of all solvers
samples     the steps at which the quality is looked at;  reference: the optimum there
contestants the solvers by name (ours, isam2, g2o_batch), each behind the same three calls
child       one run in a process of its own, on one core;  runner: many of them, kept on disk
summary     runs to rows;  table: rows to Markdown;  targets: what the rows must show
fill        the fill-in of R by ordering;  figures, fill_figures: the pictures
"""
