"""Pictures of triangles: shaded at their vertices, drawn into a depth buffer on the CPU.

No window and no OpenGL: memory is that of the picture and of one frame's triangles, and the same picture is the same to
the last bit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..device.exclusive import ALONE, compiling, refuse_recording
from ..kernels.drawing.triangles import average, draw_triangles, shade_vertices, tube_vertices

BAND = 1 << 24
"""Samples that are drawn at a time: a larger picture is drawn in bands."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """Triangles to draw, as the camera sees them: x to the right, y up, z toward it, from where it looks at (m)."""

    faces: wp.array
    """[faces, 3], counter-clockwise seen from outside."""
    place: wp.array
    """[vertices, 3], with ``normal``, out of the surface; and ``light`` [vertices], times the colour."""
    normal: wp.array
    light: wp.array
    color: tuple[float, float, float]
    two_sided: bool = False


def on_device(values: Any, dtype: Any) -> wp.array:
    """Copies an array to where pictures are drawn."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")


def tube(
    sides: int, faces: wp.array, color: tuple[float, float, float], *, centre: Any, across: Any, half: Any, shade: Any
) -> Surface:
    """Makes tubes of their rings: ``centre`` [rings, 3], ``across`` [rings, 2, 3], ``half`` [rings, 2], ``shade``
    [rings, 4] (see ``tube_vertices``)."""
    with ALONE, compiling():
        refuse_recording(wp.get_device("cpu"))
        count = len(centre) * sides
        place, normal = (wp.empty(count, dtype=wp.vec3, device="cpu") for _ in range(2))
        light = wp.empty(count, dtype=float, device="cpu")
        rings = [on_device(value, wp.vec3) for value in (centre, across[:, 0], across[:, 1])]
        inputs = [sides, *rings, on_device(half, wp.vec2), on_device(shade, wp.vec4)]
        wp.launch(tube_vertices, dim=count, inputs=inputs, outputs=[place, normal, light], device="cpu")
        return Surface(faces, place, normal, light, color)


def picture(
    surfaces: Sequence[Surface],
    size: tuple[int, int],
    *,
    distance: float,
    focal: float,
    lamps: Sequence[Sequence[float]],
    background: Sequence[int],
    samples: int,
) -> np.ndarray:
    """Draws surfaces [height, width, 3], uint8.

    Args:
        size: width and height.
        distance: from what the camera looks at [m].
        focal: pixels of what is as far from the camera as it is wide.
        lamps: direction, unit, and brightness of each, as the camera sees it [lamps, 4].
        background: red, green, blue from 0 to 255.
        samples: of a pixel, along either axis.
    """
    width, height = size[0] * samples, size[1] * samples
    with ALONE, compiling():
        refuse_recording(wp.get_device("cpu"))
        seen = [_shaded(surface, distance, focal * samples, (0.5 * width, 0.5 * height), lamps) for surface in surfaces]
        rows = max(1, min(size[1], BAND // (width * samples))) * samples
        depth = wp.empty(rows * width, dtype=float, device="cpu")
        image = wp.empty(rows * width, dtype=wp.uint32, device="cpu")
        red, green, blue = background
        result = np.empty((size[1], size[0], 3), dtype=np.uint8)
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            depth.zero_()
            image.fill_(red | green << 8 | blue << 16)
            for surface, (screen, rgb) in zip(surfaces, seen, strict=True):
                inputs = [surface.faces, screen, rgb, int(surface.two_sided), width, top, bottom, depth, image]
                wp.launch(draw_triangles, dim=len(surface.faces), inputs=inputs, device="cpu")
            pixels = wp.empty(((bottom - top) // samples, size[0], 3), dtype=wp.uint8, device="cpu")
            wp.launch(average, dim=pixels.shape[:2], inputs=[samples, width, image], outputs=[pixels], device="cpu")
            result[top // samples : bottom // samples] = pixels.numpy()
        return result


def _shaded(
    surface: Surface, distance: float, focal: float, middle: tuple[float, float], lamps: Sequence[Sequence[float]]
) -> tuple[wp.array, wp.array]:
    count = len(surface.place)
    screen, rgb = (wp.empty(count, dtype=wp.vec3, device="cpu") for _ in range(2))
    inputs = [surface.place, surface.normal, surface.light, wp.vec3(*surface.color), on_device(lamps, wp.vec4)]
    inputs += [distance, focal, wp.vec2(*middle), int(surface.two_sided)]
    wp.launch(shade_vertices, dim=count, inputs=inputs, outputs=[screen, rgb], device="cpu")
    return screen, rgb
