"""Lenses, for everybody: the map's cameras (`factorbus.solver`) and features made of pixels (`factorbus.idp`).

Only inline kernels: they are compiled into those of the two folders that use them.
"""
