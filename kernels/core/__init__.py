"""What every kernel is written with: the variant that it is compiled for, what a term says of itself, indices, memory.

Imports Warp alone.
"""
