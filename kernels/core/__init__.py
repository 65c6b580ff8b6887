"""What every kernel is written with: the variant that it is compiled for, what a term says of itself, indices, memory,
structs of arrays, and codes of what can go wrong.

Imports Warp alone.
"""
