"""Time integration: one method a file, each with its step and the adjoint of its step side by side.

A method is a class that says its ``name``, ``order`` and, in its docstring, its stability; ``advance`` makes a step of
the model's state arrays; ``prepare_adjoint`` and ``retreat`` are its reverse (``linear.py`` says what they leave).
"""

from .linear import LinearlyImplicitEuler

INTEGRATORS = {method.name: method for method in (LinearlyImplicitEuler,)}
"""Every method by its name."""
