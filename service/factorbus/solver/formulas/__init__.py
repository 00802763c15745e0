"""Machine code of kinds that clients wrote themselves, made of their formulas.  MATH §3.11.

terms       numbers and their slopes while code is made, with Python's operators
groups      operations of rotations and poses;  vectors: of vectors and numbers
residual    the function of a kind, in LLVM's language
own_code    that function compiled, and kept while a graph has the kind
"""
