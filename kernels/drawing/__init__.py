"""Pictures: vertices around yarns, their colours, and triangles in a depth buffer.

Knows nothing of simulations.
"""
