"""What yarns look like: strands, tubes, pictures and movies.

Imports no simulator.
"""
