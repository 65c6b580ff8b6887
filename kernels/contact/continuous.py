"""Continuous detection: which triangles meet on the straight way of a step from one place to another.

A vertex meets a face, or an edge an edge, where their four points lie in a plane: a cubic equation in the time t of the
step, from 0 to 1. Its roots are looked at in their order, and the first where the vertex is within the face, or the
edges cross, is an impact, with the normal n of face or edges then and the weights w of the two places that meet; n
points to the side that the first of them came from. What does not meet but ends nearer than ``near``, a vertex above
the inside of a face or the insides of two edges, is an impact too, with the normal and weights that it has at the end:
else what lies on something would fall on it anew in every step.

Vertices, edges and faces are those of the cloth, first, and of obstacles. Boxes of the bounding volume hierarchy are in
single precision, rounded outwards; all else is in double, whatever the scene's precision.
"""

import functools
from types import SimpleNamespace

import warp as wp

ROOM = 1e-6
"""How far beyond its rim a face is met, in barycentric coordinates: roots have an error."""
PARALLEL = 1e-10
"""Squared sine between edges that have no normal."""
ASKEW = 1e-2
"""Squared sine up to which the normal of two edges may point anywhere across them: those that meet take the way that
they came instead, and what is merely near is left to their ends."""
ALONG = 1e-3
"""Of the way that two places came: what of it is along the normal. With less they moved in one plane, as edges do that
lie above each other, whose ends meet instead; steps leave at least half the thickness between what slides."""
PLANE, OF_FACE, OF_EDGES, OF_EDGES_ASKEW = 0, 1, 2, 3
"""Kinds of impacts: what their normals follow from."""
NONE = 2.0
"""In place of a root that is not there."""


@functools.cache
def functions() -> SimpleNamespace:
    vec3, vec4 = wp.vec3d, wp.vec4d

    @wp.func
    def value(c: vec4, t: wp.float64) -> wp.float64:
        return ((c[3] * t + c[2]) * t + c[1]) * t + c[0]

    @wp.func
    def bisected(c: vec4, low: wp.float64, high: wp.float64) -> wp.float64:
        """Find the root between two times with values of different signs."""
        a = wp.float64(low)
        b = wp.float64(high)
        falls = value(c, a) > wp.float64(0.0)
        for _ in range(60):
            middle = wp.float64(0.5) * (a + b)
            if (value(c, middle) > wp.float64(0.0)) == falls:
                a = middle
            else:
                b = middle
        return wp.float64(0.5) * (a + b)

    @wp.func
    def cubic_roots(c: vec4) -> vec3:
        """Find the roots of c₀ + c₁ t + c₂ t² + c₃ t³ from 0 to 1, increasing; ``NONE`` for the others. A double root
        counts, though rounding may part it from 0."""
        zero, one, none = wp.float64(0.0), wp.float64(1.0), wp.float64(wp.static(NONE))
        roots = vec3(none, none, none)
        rounding = wp.float64(1e-14) * (wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) + wp.abs(c[3]))
        # where it turns: c₁ + 2 c₂ t + 3 c₃ t² = 0, by the formula that does not cancel
        first = wp.float64(wp.static(NONE))
        second = wp.float64(wp.static(NONE))
        square = c[2] * c[2] - wp.float64(3.0) * c[3] * c[1]
        if square >= zero:
            q = -(c[2] + wp.where(c[2] < zero, -one, one) * wp.sqrt(square))
            if c[3] != zero:
                first = q / (wp.float64(3.0) * c[3])
            if q != zero:
                second = c[1] / q
        low = wp.float64(0.0)
        count = int(0)
        for part in range(3):
            high = one
            if part == 0:
                high = wp.clamp(wp.min(first, second), zero, one)
            elif part == 1:
                high = wp.clamp(wp.max(first, second), zero, one)
            at_low = value(c, low)
            at_high = value(c, high)
            root = none
            if part == 0 and at_low == zero:
                root = low
            elif high > low and (at_low > zero) != (at_high > zero):
                root = bisected(c, low, high)
            elif high > low and wp.abs(at_high) <= rounding:
                root = high
            if root <= one:
                roots[count] = root
                count += 1
            low = high
        return roots

    @wp.func
    def coplanar(a: vec3, b: vec3, c: vec3, va: vec3, vb: vec3, vc: vec3) -> vec4:
        """Compute the coefficients of a(t)·(b(t) × c(t)), lowest first, of points that move by v in the step."""
        bc = wp.cross(b, c)
        mixed = wp.cross(vb, c) + wp.cross(b, vc)
        vbc = wp.cross(vb, vc)
        return vec4(
            wp.dot(a, bc),
            wp.dot(va, bc) + wp.dot(a, mixed),
            wp.dot(a, vbc) + wp.dot(va, mixed),
            wp.dot(va, vbc),
        )

    @wp.func
    def within_face(x: vec3, a: vec3, b: vec3, c: vec3) -> vec4:
        """Compute the weights of a face's corners at the foot of a point, and whether that is within the face."""
        ab = b - a
        ac = c - a
        n = wp.cross(ab, ac)
        area = wp.dot(n, n)
        if area == wp.float64(0.0):
            return vec4()
        u = wp.dot(wp.cross(x - a, ac), n) / area
        v = wp.dot(wp.cross(ab, x - a), n) / area
        w = wp.float64(1.0) - u - v
        inside = wp.where(wp.min(wp.min(u, v), w) >= wp.float64(wp.static(-ROOM)), wp.float64(1.0), wp.float64(0.0))
        return vec4(w, u, v, inside)

    @wp.func
    def crossing_edges(a: vec3, b: vec3, c: vec3, d: vec3) -> vec3:
        """Find the parameters s, t of the points a + s (b − a) and c + t (d − c) of two lines that are closest, and
        whether both are within the edges."""
        zero, one = wp.float64(0.0), wp.float64(1.0)
        e = b - a
        f = d - c
        r = c - a
        ee = wp.dot(e, e)
        ff = wp.dot(f, f)
        ef = wp.dot(e, f)
        det = ee * ff - ef * ef
        if det <= wp.float64(wp.static(PARALLEL)) * ee * ff:
            return vec3()
        er = wp.dot(e, r)
        fr = wp.dot(f, r)
        s = (er * ff - fr * ef) / det
        t = (er * ef - fr * ee) / det
        room = wp.float64(wp.static(ROOM))
        inside = s >= -room and s <= one + room and t >= -room and t <= one + room
        return vec3(s, t, wp.where(inside, one, zero))

    @wp.func
    def square_of_sine(a: vec3, b: vec3) -> wp.float64:
        n = wp.cross(a, b)
        return wp.dot(n, n) / (wp.dot(a, a) * wp.dot(b, b))

    return SimpleNamespace(
        square_of_sine=square_of_sine,
        cubic_roots=cubic_roots,
        coplanar=coplanar,
        within_face=within_face,
        crossing_edges=crossing_edges,
    )


@functools.cache
def define() -> SimpleNamespace:
    vec3, vec4 = wp.vec3d, wp.vec4d
    parts = functions()
    cubic_roots, coplanar, square_of_sine = parts.cubic_roots, parts.coplanar, parts.square_of_sine
    within_face, crossing_edges = parts.within_face, parts.crossing_edges
    module = "warp_yarn_continuous"

    @wp.struct
    class Surface:
        """Triangles and edges of the cloth, whose nodes and triangles come first, and of obstacles."""

        nodes: int
        triangles: int
        touches_itself: int
        start: wp.array(dtype=vec3)
        end: wp.array(dtype=vec3)
        faces: wp.array(dtype=wp.vec3i)
        edges: wp.array(dtype=wp.vec2i)
        # of each face the edges that are looked for there: every edge has one
        owned: wp.array(dtype=wp.vec3i)

    @wp.struct
    class Impacts:
        """What was found: kind, time (1 of what is merely near), four vertices, their weights, the normal; and how many
        there are, with room or not."""

        count: wp.array(dtype=int)
        kinds: wp.array(dtype=int)
        times: wp.array(dtype=wp.float64)
        vertices: wp.array(dtype=wp.vec4i)
        weights: wp.array(dtype=vec4)
        normals: wp.array(dtype=vec3)

    @wp.func
    def note(impacts: Impacts, kind: int, t: wp.float64, vertices: wp.vec4i, weights: vec4, normal: vec3):
        k = wp.atomic_add(impacts.count, 0, 1)
        if k < impacts.vertices.shape[0]:
            impacts.kinds[k] = kind
            impacts.times[k] = t
            impacts.vertices[k] = vertices
            impacts.weights[k] = weights
            impacts.normals[k] = normal

    @wp.func
    def at(surface: Surface, i: int, t: wp.float64) -> vec3:
        return surface.start[i] + (surface.end[i] - surface.start[i]) * t

    @wp.func
    def pulled(surface: Surface, vertices: wp.vec4i, weights: vec4, t: wp.float64) -> vec3:
        """Find how far the first of two places is from the second."""
        result = vec3()
        for k in range(4):
            result += at(surface, vertices[k], t) * weights[k]
        return result

    @wp.func
    def look(surface: Surface, impacts: Impacts, vertices: wp.vec4i, of_edges: int, near: wp.float64):
        """Note the impact of a vertex and a face, or of two edges, if there is one."""
        zero, one = wp.float64(0.0), wp.float64(1.0)
        o = surface.start[vertices[0]]
        vo = surface.end[vertices[0]] - o
        a = surface.start[vertices[1]] - o
        b = surface.start[vertices[2]] - o
        c = surface.start[vertices[3]] - o
        va = surface.end[vertices[1]] - surface.start[vertices[1]] - vo
        vb = surface.end[vertices[2]] - surface.start[vertices[2]] - vo
        vc = surface.end[vertices[3]] - surface.start[vertices[3]] - vo
        roots = cubic_roots(coplanar(a, b, c, va, vb, vc))
        for k in range(3):
            t = roots[k]
            if t <= one:
                pa = a + va * t
                pb = b + vb * t
                pc = c + vc * t
                weights = vec4()
                normal = vec3()
                kind = int(wp.static(OF_FACE))
                if of_edges != 0:
                    st = crossing_edges(vec3(), pa, pb, pc)
                    if st[2] > zero:
                        weights = vec4(one - st[0], st[0], st[1] - one, -st[1])
                        normal = wp.normalize(wp.cross(pa, pc - pb))
                        kind = wp.static(OF_EDGES)
                        if square_of_sine(pa, pc - pb) <= wp.float64(wp.static(ASKEW)):
                            kind = wp.static(OF_EDGES_ASKEW)
                            normal = wp.normalize(pulled(surface, vertices, weights, zero))
                else:
                    w = within_face(vec3(), pa, pb, pc)
                    if w[3] > zero:
                        weights = vec4(one, -w[0], -w[1], -w[2])
                        normal = wp.normalize(wp.cross(pb - pa, pc - pa))
                if weights[0] != zero or weights[1] != zero:
                    came = pulled(surface, vertices, weights, zero)
                    if wp.dot(normal, came) < zero:
                        normal = -normal
                    # what comes back to its side is no impact: the end is what counts
                    across = wp.dot(normal, came) > wp.float64(wp.static(ALONG)) * wp.length(came)
                    if across and wp.dot(normal, pulled(surface, vertices, weights, one)) < zero:
                        note(impacts, kind, t, vertices, weights, normal)
                        return
        weights = vec4()
        if of_edges != 0:
            st = crossing_edges(vec3(), a + va, b + vb, c + vc)
            if st[2] > zero and square_of_sine(a + va, c + vc - b - vb) > wp.float64(wp.static(ASKEW)):
                weights = vec4(one - st[0], st[0], st[1] - one, -st[1])
        else:
            foot = within_face(vec3(), a + va, b + vb, c + vc)
            if foot[3] > zero:
                weights = vec4(one, -foot[0], -foot[1], -foot[2])
        if weights[0] != zero or weights[1] != zero:
            apart = pulled(surface, vertices, weights, one)
            distance = wp.length(apart)
            came = pulled(surface, vertices, weights, zero)
            across = wp.dot(apart, came) > wp.float64(wp.static(ALONG)) * wp.length(came) * distance
            if across and distance < near:
                note(impacts, wp.static(OF_FACE) + of_edges, one, vertices, weights, apart / distance)

    @wp.func
    def may_touch(surface: Surface, of_cloth: bool, face: int) -> bool:
        """Say whether two things are looked at: one must be of the cloth, and both if it may touch itself."""
        other = face < surface.triangles
        if of_cloth and other:
            return surface.touches_itself != 0
        return of_cloth or other

    @wp.kernel(module=module, enable_backward=False)
    def find_vertices(
        tree: wp.uint64,
        surface: Surface,
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        near: wp.float64,
        impacts: Impacts,
    ):
        """Look for the faces that a vertex meets."""
        i = wp.tid()
        query = wp.bvh_query_aabb(tree, lower[i], upper[i])
        face = int(0)
        while wp.bvh_query_next(query, face):
            f = surface.faces[face]
            if f[0] != i and f[1] != i and f[2] != i and may_touch(surface, i < surface.nodes, face):
                look(surface, impacts, wp.vec4i(i, f[0], f[1], f[2]), 0, near)

    @wp.kernel(module=module, enable_backward=False)
    def find_edges(
        tree: wp.uint64,
        surface: Surface,
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        near: wp.float64,
        impacts: Impacts,
    ):
        """Look for the later edges that an edge meets."""
        i = wp.tid()
        e = surface.edges[i]
        query = wp.bvh_query_aabb(tree, lower[i], upper[i])
        face = int(0)
        while wp.bvh_query_next(query, face):
            if may_touch(surface, e[0] < surface.nodes, face):
                for k in range(3):
                    j = surface.owned[face][k]
                    if j > i:
                        f = surface.edges[j]
                        if e[0] != f[0] and e[0] != f[1] and e[1] != f[0] and e[1] != f[1]:
                            look(surface, impacts, wp.vec4i(e[0], e[1], f[0], f[1]), 1, near)

    @wp.kernel(module=module, enable_backward=False)
    def find_crossings(
        tree: wp.uint64,
        surface: Surface,
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        impacts: Impacts,
    ):
        """Look for the faces that an edge goes through where it starts."""
        i = wp.tid()
        e = surface.edges[i]
        a = surface.start[e[0]]
        b = surface.start[e[1]]
        query = wp.bvh_query_aabb(tree, lower[i], upper[i])
        face = int(0)
        while wp.bvh_query_next(query, face):
            f = surface.faces[face]
            apart = f[0] != e[0] and f[1] != e[0] and f[2] != e[0] and f[0] != e[1] and f[1] != e[1] and f[2] != e[1]
            if apart and may_touch(surface, e[0] < surface.nodes, face):
                p = surface.start[f[0]]
                n = wp.cross(surface.start[f[1]] - p, surface.start[f[2]] - p)
                from_a = wp.dot(n, a - p)
                from_b = wp.dot(n, b - p)
                if (from_a > wp.float64(0.0)) != (from_b > wp.float64(0.0)):
                    x = a + (b - a) * (from_a / (from_a - from_b))
                    if within_face(x, p, surface.start[f[1]], surface.start[f[2]])[3] > wp.float64(0.0):
                        note(impacts, 0, wp.float64(0.0), wp.vec4i(e[0], f[0], f[1], f[2]), vec4(), vec3())

    @wp.kernel(module=module, enable_backward=False)
    def solve_cubics(coefficients: wp.array(dtype=vec4), roots: wp.array(dtype=vec3)):
        """Find the roots of many: what a test looks at."""
        i = wp.tid()
        roots[i] = cubic_roots(coefficients[i])

    return SimpleNamespace(
        Surface=Surface,
        Impacts=Impacts,
        find_vertices=find_vertices,
        find_edges=find_edges,
        find_crossings=find_crossings,
        solve_cubics=solve_cubics,
    )
