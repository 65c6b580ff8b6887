"""The linear system of a step: its blocks, and the preconditioned conjugate gradients that solve it.

Imports ``core`` and the codes of what can go wrong. Knows no term.
"""
