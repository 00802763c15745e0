"""Jobs for workers: dispatched, checked, done in place where there is no worker."""
