"""Newton's iteration on an implicit stage: what it starts from, how far it steps, when it ends.

Imports ``core`` and the codes of what can go wrong. Knows no term.
"""
