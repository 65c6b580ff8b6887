"""A scene on the device: its declared arrays, launches and captured graphs, and who may use Warp at a time.

Imports descriptions and kernels, and no method of time integration.
"""
