"""Triangles in a depth buffer, shaded at their vertices.

What shines is Phong's: ambient light 0.15, 0.9 n·l of every lamp, and 0.12 (r·e)¹² of it, r the mirrored direction and
e that of the eye.
"""

import warp as wp

MODULE = "warp_yarn_drawing"
"""Of Warp, for itself: who draws need not compile a simulation."""


@wp.kernel(module=MODULE, enable_backward=False)
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
    """Place vertices around rings; a yarn is darker near the middle of the cloth, where others are around it."""
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


@wp.kernel(module=MODULE, enable_backward=False)
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
    """Find where vertices are on the screen, with 1 over their depth, and what colour they have there."""
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


@wp.kernel(module=MODULE, enable_backward=False)
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
    """Draw triangles, of which the nearest wins; one after the other, as the CPU does."""
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


@wp.kernel(module=MODULE, enable_backward=False)
def average(
    samples: int,
    width: int,
    image: wp.array(dtype=wp.uint32),
    pixels: wp.array(dtype=wp.uint8, ndim=3),
):
    """Average samples × samples."""
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
