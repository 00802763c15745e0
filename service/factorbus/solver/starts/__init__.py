"""Where to begin when a whole graph is solved at once, without looking at the values it has.  MATH §12.

relations        what the factors say of one pose seen from another, of a point seen from a pose, of either in the map
rotations        averaged: a linear problem once matrices need not be rotations
translations     a linear problem once the rotations are known; points with it
components       poses that no relative poses join: brought to where what both have seen lies on itself
averaged         all of these, one after the other
"""
