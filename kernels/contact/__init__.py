"""What touches: distances to obstacles, the barrier with friction that keeps cloth off them and off itself, and the
limits under which no step of Newton's iteration passes through anything.

Imports ``core``, and of ``linear`` the blocks that pairs add to the matrix.
"""
