"""One physical effect a file: its energy, force, matrix and parameters side by side.

Imports ``core``, and no other term but for what two share: the mollifier, and k_s of a yarn.
"""
