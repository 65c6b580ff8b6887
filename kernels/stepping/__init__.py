"""A time step around its solves, forward and adjoint: updates, frames, the watch over energy.

Imports ``core``. Knows no term.
"""
