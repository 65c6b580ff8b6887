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

BAND = 1 << 24
"""Samples that are drawn at a time: a larger picture is drawn in bands."""


@wp.kernel(module="warp_yarn_drawing", enable_backward=False)
def tube_vertices(
    sides: int,
    centre: wp.array(dtype=wp.vec3),
    across: wp.array(dtype=wp.vec3),
    up: wp.array(dtype=wp.vec3),
    half: wp.array(dtype=wp.vec2),
    shade: wp.array(dtype=wp.vec4),
    place: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    light: wp.array(dtype=float),
):
    """Vertices around rings; a yarn is darker the nearer it is to the middle of the cloth, where others are around it."""
    v = wp.tid()
    ring = v // sides
    angle = float(v - ring * sides) * (2.0 * wp.pi / float(sides))
    c, s = wp.cos(angle), wp.sin(angle)
    size = half[ring]
    place[v] = centre[ring] + across[ring] * (size[0] * c) + up[ring] * (size[1] * s)
    # shade: the ring's height over the middle, 1 over the height from where it is in the open, how much it is among
    # others, and which way along the yarn it looks if it is a cap's
    cap = shade[ring][3]
    if cap == 0.0:
        normal[v] = wp.normalize(across[ring] * (size[1] * c) + up[ring] * (size[0] * s))
    else:
        normal[v] = wp.cross(across[ring], up[ring]) * cap
    x = wp.clamp(wp.abs(shade[ring][0] + size[1] * s) * shade[ring][1], 0.0, 1.0)
    light[v] = 1.0 - 0.6 * shade[ring][2] * (1.0 - x * x * (3.0 - 2.0 * x))


@wp.kernel(module="warp_yarn_drawing", enable_backward=False)
def shade_vertices(
    place: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    light: wp.array(dtype=float),
    color: wp.vec3,
    lamps: wp.array(dtype=wp.vec4),
    distance: float,
    focal: float,
    middle: wp.vec2,
    two_sided: int,
    screen: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
):
    """Where vertices are on the screen, with 1 over their depth, and what colour they have there."""
    v = wp.tid()
    p = place[v]
    eye = wp.vec3(0.0, 0.0, distance) - p
    depth = eye[2]
    inverse = 0.0
    if depth > 0.01 * distance:
        inverse = 1.0 / depth
    screen[v] = wp.vec3(middle[0] + focal * p[0] * inverse, middle[1] - focal * p[1] * inverse, inverse)
    side = float(1.0)
    if two_sided != 0 and wp.dot(normal[v], eye) < 0.0:
        side = -1.0
    n = normal[v] * side
    toward = wp.normalize(eye)
    diffuse, shine = float(0.15), float(0.0)
    for k in range(lamps.shape[0]):
        way = wp.vec3(lamps[k][0], lamps[k][1], lamps[k][2])
        facing = wp.dot(n, way)
        if facing > 0.0:
            diffuse += 0.9 * lamps[k][3] * facing
            mirrored = wp.dot(n * (2.0 * facing) - way, toward)
            if mirrored > 0.0:
                shine += 0.12 * lamps[k][3] * wp.pow(mirrored, 12.0)
    rgb[v] = (color * diffuse + wp.vec3(shine, shine, shine)) * light[v]


@wp.func
def pack(color: wp.vec3):
    r = wp.uint32(wp.clamp(color[0], 0.0, 1.0) * 255.0 + 0.5)
    g = wp.uint32(wp.clamp(color[1], 0.0, 1.0) * 255.0 + 0.5)
    b = wp.uint32(wp.clamp(color[2], 0.0, 1.0) * 255.0 + 0.5)
    return r | (g << wp.uint32(8)) | (b << wp.uint32(16))


@wp.kernel(module="warp_yarn_drawing", enable_backward=False)
def draw_triangles(
    faces: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
    two_sided: int,
    width: int,
    top: int,
    bottom: int,
    depth: wp.array(dtype=float),
    image: wp.array(dtype=wp.uint32),
):
    """Nearest wins. Threads are not safe from each other: the CPU runs one after the other."""
    face = faces[wp.tid()]
    a, b, c = screen[face[0]], screen[face[1]], screen[face[2]]
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if a[2] <= 0.0 or b[2] <= 0.0 or c[2] <= 0.0 or area == 0.0:
        return
    # y points down on the screen: what faces the camera runs the other way round
    if area > 0.0 and two_sided == 0:
        return
    low_x = wp.max(int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])) - 0.5)), 0)
    high_x = wp.min(int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])) - 0.5)), width - 1)
    low_y = wp.max(int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])) - 0.5)), top)
    high_y = wp.min(int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])) - 0.5)), bottom - 1)
    if low_x > high_x or low_y > high_y:
        return
    scale = 1.0 / area
    # weights of the corners b and c, and their steps from pixel to pixel
    bx, by = (c[1] - a[1]) * scale, -(c[0] - a[0]) * scale
    cx, cy = -(b[1] - a[1]) * scale, (b[0] - a[0]) * scale
    x0, y0 = float(low_x) + 0.5 - a[0], float(low_y) + 0.5 - a[1]
    row_b, row_c = bx * x0 + by * y0, cx * x0 + cy * y0
    to_b, to_c = b[2] - a[2], c[2] - a[2]
    color, color_b, color_c = rgb[face[0]], rgb[face[1]] - rgb[face[0]], rgb[face[2]] - rgb[face[0]]
    for y in range(low_y, high_y + 1):
        wb = row_b + by * float(y - low_y)
        wc = row_c + cy * float(y - low_y)
        at = (y - top) * width + low_x
        for _x in range(low_x, high_x + 1):
            if wb >= 0.0 and wc >= 0.0 and wb + wc <= 1.0:
                near = a[2] + wb * to_b + wc * to_c
                if near > depth[at]:
                    depth[at] = near
                    image[at] = pack(color + color_b * wb + color_c * wc)
            wb += bx
            wc += cx
            at += 1


@wp.kernel(module="warp_yarn_drawing", enable_backward=False)
def average(
    samples: int,
    width: int,
    image: wp.array(dtype=wp.uint32),
    pixels: wp.array(dtype=wp.uint8, ndim=3),
):
    """Means of samples × samples."""
    y, x = wp.tid()
    r, g, b = int(0), int(0), int(0)
    for j in range(samples):
        for i in range(samples):
            value = int(image[(y * samples + j) * width + x * samples + i])
            r += value & 255
            g += (value >> 8) & 255
            b += (value >> 16) & 255
    count = samples * samples
    pixels[y, x, 0] = wp.uint8((r + count // 2) // count)
    pixels[y, x, 1] = wp.uint8((g + count // 2) // count)
    pixels[y, x, 2] = wp.uint8((b + count // 2) // count)


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
