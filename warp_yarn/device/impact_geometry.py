"""How the normal and the weights of an impact follow from the places that it was found by, and the adjoint of that.

The same formulas as those of ``kernels/contact/continuous.py``, of complex numbers: a derivative is the imaginary part
of a step along the imaginary axis, right to rounding. The time of an impact follows too: dt = −df/(∂f/∂t) of the cubic
f = 0.
"""

from __future__ import annotations

import numpy as np

from ..kernels.contact.continuous import OF_EDGES, OF_EDGES_ASKEW, PLANE
from .impacts import Found

STEP = 1e-30


def adjoint(
    found: Found, start: np.ndarray, end: np.ndarray, to_weights: np.ndarray, to_normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Take adjoints of weights and normals back.

    Args:
        found: impacts.
        start, end: where their vertices were at the start and end of the way [impacts, 4, 3] (m).
        to_weights, to_normals: adjoints [impacts, 4] and [impacts, 3].

    Returns:
        Adjoints of start and end [impacts, 4, 3].
    """
    result = np.zeros((2, *start.shape))
    moves = np.flatnonzero(found.kinds != PLANE)
    found, ends = found.pick(moves), np.stack([start[moves], end[moves]]).astype(complex)
    for which, vertex, axis in np.ndindex(2, 4, 3):
        ends[which, :, vertex, axis] += 1j * STEP
        weights, normals = geometry(found, *ends)
        change = (weights.imag * to_weights[moves]).sum(axis=1) + (normals.imag * to_normals[moves]).sum(axis=1)
        result[which, moves, vertex, axis] = change / STEP
        ends[which, :, vertex, axis] -= 1j * STEP
    return result[0], result[1]


def geometry(found: Found, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute weights [impacts, 4] and normals [impacts, 3], of the kind and near the time that each was found with."""
    motion = end - start
    time = found.times[:, None, None]
    at_time = start + time * motion
    # what was near has no time to follow: it is the way's end
    edges, speeds = (values[:, 1:] - values[:, :1] for values in (at_time, motion))
    slope = sum(_triple(*(speeds[:, j] if j == k else edges[:, j] for j in range(3))) for k in range(3))
    met = found.times < 1.0
    time = time - np.where(met, _triple(*edges.swapaxes(0, 1)) / np.where(met, slope.real, 1.0), 0.0)[:, None, None]
    p = start + time * motion
    of_edges = np.isin(found.kinds, (OF_EDGES, OF_EDGES_ASKEW))
    weights = np.where(of_edges[:, None], _weights_of_edges(p), _weights_of_face(p))
    across = np.cross(p[:, 1] - p[:, 0], p[:, 3] - p[:, 2])
    normals = np.where(of_edges[:, None], across, np.cross(p[:, 2] - p[:, 1], p[:, 3] - p[:, 1]))
    came = np.einsum("ki,kij->kj", weights, start)
    normals = np.where((found.kinds == OF_EDGES_ASKEW)[:, None], came, normals)
    normals = normals / np.sqrt(_dot(normals, normals))[:, None]
    side = np.sign(_dot(normals, found.normals).real)
    return weights, normals * side[:, None]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1)


def _triple(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return _dot(a, np.cross(b, c))


def _weights_of_face(p: np.ndarray) -> np.ndarray:
    """Compute the weights of a vertex, 1, and of the corners of a face at its foot."""
    ab, ac, ax = p[:, 2] - p[:, 1], p[:, 3] - p[:, 1], p[:, 0] - p[:, 1]
    n = np.cross(ab, ac)
    area = _dot(n, n)
    area = np.where(area == 0.0, 1.0, area)
    u, v = _dot(np.cross(ax, ac), n) / area, _dot(np.cross(ab, ax), n) / area
    return np.stack([np.ones_like(u), u + v - 1.0, -u, -v], axis=1)


def _weights_of_edges(p: np.ndarray) -> np.ndarray:
    """Compute the weights of the ends of two edges, where their lines are closest."""
    e, f, r = p[:, 1] - p[:, 0], p[:, 3] - p[:, 2], p[:, 2] - p[:, 0]
    ee, ff, ef = _dot(e, e), _dot(f, f), _dot(e, f)
    det = ee * ff - ef * ef
    det = np.where(det == 0.0, 1.0, det)
    s = (_dot(e, r) * ff - _dot(f, r) * ef) / det
    t = (_dot(e, r) * ef - _dot(f, r) * ee) / det
    return np.stack([1.0 - s, s, t - 1.0, -t], axis=1)
