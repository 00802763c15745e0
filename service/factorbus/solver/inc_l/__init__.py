"""The incremental modes of the 2013 paper: R is updated, or computed anew."""
