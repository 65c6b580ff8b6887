"""Files: USD, the published data, and how a file appears whole or not at all.

Imports no simulator.
"""
