"""The physics a second time, in torch float64, from the formulas alone: what the kernels are held to.

Written from ``physics.md`` row by row and column by column, not from the kernels nor from the topology.
Energies are functions of one element; forces, Jacobians and Hessians come of them by automatic differentiation.

Unknowns stand in one vector, as in ``Simulator.system``: q = (x of every node, then u, v of every node), and v = q̇.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch.func import grad, hessian, jvp, vmap

import warp_yarn as wy

RIGHT = 0.5 * math.pi
TERMS = (
    "inertia", "mass_rate", "stretch", "crimp_interchange", "bending", "gravity", "parallel", "shear", "wind", "pins",
    "applied", "friction", "seams",
)  # fmt: skip

Tensor = torch.Tensor


def tensor(values: object) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


def draft(weave: str, rows: int, columns: int) -> list[list[bool]]:
    """Flipped crossings of a weave of the paper, [row][column]."""

    def flipped(i: int, j: int) -> bool:
        if i in (0, columns - 1) or j in (0, rows - 1):
            return False
        if weave == "plain":
            return (i + j) % 2 == 1
        if weave == "twill":
            return (i + j % 4) % 4 < 2
        r = (j - 1) % 4
        offset = 3 * (r // 2) + 2 * (r % 2)
        return (i - 1 + offset) % 4 == 0

    return [[flipped(i, j) for i in range(columns)] for j in range(rows)]


# -- energies of one element -----------------------------------------------------------------------------------------


def unit(d: Tensor) -> Tensor:
    return d / torch.linalg.vector_norm(d)


def stretch(q: Tensor, k: Tensor, longer: Tensor) -> Tensor:
    """q = (x_a, x_b, s_a, s_b); longer: the yarn's length over the distance that it covers, as woven."""
    rest = q[7] - q[6]
    return 0.5 * k * rest * (longer * torch.linalg.vector_norm((q[3:6] - q[0:3]) / rest) - 1.0) ** 2


def kinetic(q: Tensor, v: Tensor, density: Tensor) -> Tensor:
    rest = q[7] - q[6]
    w = (q[3:6] - q[0:3]) / rest
    a = v[0:3] - w * v[6]
    b = v[3:6] - w * v[7]
    return density * rest / 6.0 * (a @ a + a @ b + b @ b)


def gravity(q: Tensor, density: Tensor, g: Tensor) -> Tensor:
    return -density * (q[7] - q[6]) * (g @ (q[0:3] + q[3:6])) / 2.0


def parallel(q: Tensor, k: Tensor, distance: Tensor, guard: Tensor, reach: Tensor) -> Tensor:
    """q = (s_a, s_b); guard: the barrier's stiffness [N]."""
    rest = q[1] - q[0]
    near = torch.minimum(rest, reach)
    return 0.5 * k * torch.relu(distance - rest) ** 2 - guard / reach * (near - reach) ** 2 * torch.log(near / reach)


def pin(q: Tensor, k: Tensor, target: Tensor) -> Tensor:
    return 0.5 * k * (q - target) @ (q - target)


def seam(q: Tensor, k: Tensor) -> Tensor:
    """q = (x_a, x_b)"""
    return 0.5 * k * (q[3:6] - q[0:3]) @ (q[3:6] - q[0:3])


def angle(t1: Tensor, t2: Tensor) -> Tensor:
    """Between unit vectors, to full precision (W. Kahan)."""
    difference, total = t1 - t2, t1 + t2
    return 2.0 * torch.atan2(torch.sqrt(difference @ difference), torch.sqrt(total @ total))


def angle_squared(t1: Tensor, t2: Tensor) -> Tensor:
    """Smooth where the vectors are the same: (2 arcsin √y)² = 2 Σ (4y)ⁿ / (n² C(2n, n)) of y = |t1 − t2|²/4."""
    y = (t1 - t2) @ (t1 - t2) / 4.0
    series = tensor(0.0)
    for n in range(6, 0, -1):
        series = 4.0 * y * (2.0 / (n**2 * math.comb(2 * n, n)) + series)
    # Both branches are differentiated, so the closed form is given a pair at a right angle where it is not wanted.
    near = y < 1e-3
    apart = angle(torch.where(near, tensor([1.0, 0, 0]), t1), torch.where(near, tensor([0, 1.0, 0]), t2))
    return torch.where(near, series, apart**2)


def presence(d: Tensor, spacing: Tensor | float) -> Tensor:
    """1 for a segment d of a tenth of the spacing or more, 0 for one of no length: 6x⁵ − 15x⁴ + 10x³."""
    x = torch.clamp(torch.linalg.vector_norm(d) / (0.1 * spacing), max=1.0)
    return 6.0 * x**5 - 15.0 * x**4 + 10.0 * x**3


def faded(energy: Tensor, largest: Tensor, e1: Tensor, e2: Tensor, l1: Tensor, l2: Tensor) -> Tensor:
    """An energy of the angle between two segments, and their distances at rest."""
    part = presence(e1, l1) * presence(e2, l2)
    return part * energy + (1.0 - part) * largest


def bending(q: Tensor, k: Tensor, l1: Tensor, l2: Tensor) -> Tensor:
    """q = (x_a, x_c, x_b, s_a, s_b); l1 of c to b, l2 of a to c."""
    e1, e2 = q[6:9] - q[3:6], q[0:3] - q[3:6]
    return faded(k * angle_squared(unit(e1), -unit(e2)), k * math.pi**2, e1, e2, l1, l2) / (q[10] - q[9])


def crimped_segment(p: Tensor, h: Tensor, rest: Tensor, k: Tensor, b: Tensor, woven: Tensor) -> Tensor:
    """Energy of a segment that rises by h; woven = (distance, length) as woven."""
    cosine = woven[0] / woven[1]
    sine = torch.sqrt(1.0 - cosine**2)
    strain = torch.sqrt(p**2 + 9.0 / 8.0 * h**2) / rest - 1.0
    beam = 12.0 * b / woven[1] ** 2
    limit = 0.25 * beam * cosine**2
    y = k * torch.clamp(-strain, min=0.0) / limit
    pull = torch.where(strain > 0.0, 0.5 * k * strain**2, limit**2 / k * (y - torch.log1p(y)))
    off = math.sqrt(9.0 / 8.0) * h * cosine - p * sine
    return rest * pull + 0.5 * beam * off**2 / rest


def crimped_crossing(q: Tensor, parts: Tensor, k: Tensor, b: Tensor, woven: Tensor, total: Tensor) -> Tensor:
    """q = (x of the crossing and left, right, up, down of it, their u, their v); parts of the four segments that are
    crimped, and woven of each [4, 2]; k, b [2] of warp and weft."""
    return crossing_of_lengths(*segments_of(q), parts, k, b, woven, total)


def segments_of(q: Tensor) -> tuple[Tensor, Tensor]:
    """p and Δs of a crossing's four segments."""
    x, u, v = q[:15].reshape(5, 3), q[15:20], q[20:25]
    p = torch.linalg.vector_norm(x[1:] - x[0], dim=1)
    return p, torch.stack([u[0] - u[1], u[2] - u[0], v[0] - v[3], v[4] - v[0]])


def crossing_of_lengths(
    p: Tensor, rest: Tensor, parts: Tensor, k: Tensor, b: Tensor, woven: Tensor, total: Tensor
) -> Tensor:
    """The least energy of any h."""

    def energy(h: Tensor, p: Tensor, rest: Tensor) -> Tensor:
        heights = torch.stack([h, h, total - h, total - h])
        each = vmap(crimped_segment)(p, heights, rest, k.repeat_interleave(2), b.repeat_interleave(2), woven)
        return (parts * each).sum()

    slope = grad(energy)
    low, high = -3.0 * total, 4.0 * total
    fixed = p.detach(), rest.detach()
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = slope(middle, *fixed) > 0.0
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    h = (0.5 * (low + high)).detach()
    # every step of Newton's iteration makes another derivative exact
    for _ in range(2):
        curvature = grad(slope)(h, p, rest)
        h = h - torch.where(curvature > 0.0, slope(h, p, rest) / torch.where(curvature > 0.0, curvature, 1.0), 0.0)
    return energy(h, p, rest)


def straight_segment(q: Tensor, k: Tensor, part: Tensor, woven: Tensor) -> Tensor:
    """As stretch, of a yarn that keeps its crimp."""
    rest = q[7] - q[6]
    strain = torch.linalg.vector_norm(q[3:6] - q[0:3]) / rest * woven[1] / woven[0] - 1.0
    return part * 0.5 * k * rest * strain**2


def lock(phi: Tensor, threshold: Tensor | float, ratio: Tensor | float) -> Tensor:
    """Eq. 5, with c = 3 and σ = 0.6, and γ = 0 beyond the right angle; threshold φ_l, ratio L/R."""
    gamma = torch.relu((math.sqrt(2.0) - 2.0 * torch.sin(phi / 2.0)) * ratio)
    denominator = (phi * (phi - threshold) * (phi - RIGHT)) ** 2 + RIGHT**4 * 0.6**2
    return 0.5 * ((1.0 + gamma**3) + (1.0 - gamma**3) * torch.tanh(RIGHT**5 * (phi - threshold) / denominator))


def shear(q: Tensor, k: Tensor, jams: Tensor, l1: Tensor, l2: Tensor, threshold: Tensor, ratio: Tensor) -> Tensor:
    """q = (x_p, x_c, x_r); k = S π R² (1 + F_n) L; l1 of c to p, l2 of c to r."""
    e1, e2 = q[0:3] - q[3:6], q[6:9] - q[3:6]
    phi = angle(unit(e1), unit(e2))
    factor = torch.where(jams, lock(phi, threshold, ratio), tensor(1.0))
    largest = 0.5 * k * RIGHT**2 * torch.where(jams, lock(tensor(0.0), threshold, ratio), tensor(1.0))
    return faded(0.5 * k * factor * (phi - RIGHT) ** 2, largest, e1, e2, l1, l2)


def wind(q: Tensor, v: Tensor, velocity: Tensor, density: float, drag: float) -> Tensor:
    """Force on each of a triangle's three nodes; q and v = (x, y, z of each)."""
    i, j, k = q[0:3], q[3:6], q[6:9]
    cross = torch.linalg.cross(j - i, k - i)
    area, n = torch.linalg.vector_norm(cross) / 2.0, unit(cross)
    relative = velocity - (v[0:3] + v[3:6] + v[6:9]) / 3.0
    along = n @ relative
    force = density * area * torch.abs(along) * along * n + drag * area * (relative - along * n)
    return (force / 3.0).repeat(3)


# -- a whole cloth ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Elements:
    """Elements of one kind: the unknowns of each [elements, m], its energy, and the parameters of each."""

    unknowns: Tensor
    local: Callable[..., Tensor]
    parameters: tuple[Tensor, ...]

    def energy(self, q: Tensor) -> Tensor:
        return vmap(self.local)(q[self.unknowns], *self.parameters).sum()

    def force(self, q: Tensor) -> Tensor:
        return -grad(self.energy)(q)

    def hessians(self, q: Tensor) -> Tensor:
        """Exact, of every element by itself."""
        return vmap(hessian(self.local))(q[self.unknowns], *self.parameters)

    def matrix(self, blocks: Tensor, size: int) -> Tensor:
        """The sum of the elements' blocks [elements, m, m] in a dense matrix."""
        result = torch.zeros(size, size, dtype=torch.float64)
        rows, columns = self.unknowns[:, :, None].expand_as(blocks), self.unknowns[:, None, :].expand_as(blocks)
        return result.index_put((rows, columns), blocks, accumulate=True)

    def of(self, which: list[bool]) -> Elements:
        keep = torch.tensor(which)
        return Elements(self.unknowns[keep], self.local, tuple(p[keep] for p in self.parameters))


def clamped(blocks: Tensor) -> Tensor:
    """Symmetric matrices with their negative eigenvalues set to 0."""
    values, vectors = torch.linalg.eigh(blocks)
    return vectors @ torch.diag_embed(values.clamp(min=0.0)) @ vectors.mT


class Oracle:
    """Every term of a scene."""

    def __init__(self, scene: wy.Scene):
        cloth = scene.cloth
        self.scene, self.cloth = scene, cloth
        self.rows, self.columns = cloth.weave.rows, cloth.weave.columns
        self.nodes = self.rows * self.columns
        self.size = 5 * self.nodes
        named = cloth.weave.name in wy.WEAVES
        self.flipped = draft(cloth.weave.name, self.rows, self.columns) if named else cloth.weave.flipped.tolist()
        # Yarns alternate, in both directions.
        self.warp = [cloth.yarns[j % len(cloth.yarns)] for j in range(self.rows)]
        self.weft = [cloth.yarns[i % len(cloth.yarns)] for i in range(self.columns)]
        # distances between weft yarns, along u, and between warp yarns, along v; and by how much yarns are longer
        warp, weft = cloth.spacing if isinstance(cloth.spacing, tuple) else (cloth.spacing, cloth.spacing)
        self.along = (self.each(weft, self.columns - 1), self.each(warp, self.rows - 1))
        warp, weft = cloth.crimp if isinstance(cloth.crimp, tuple) else (cloth.crimp, cloth.crimp)
        self.crimp = (self.each(warp, self.rows), self.each(weft, self.columns))
        self.slides = torch.zeros(self.rows, self.columns, 2, dtype=torch.float64)
        if scene.sliding:
            self.slides[1:-1, 1:-1] = 1.0
        self.slides = self.slides.ravel()
        self._build()

    # -- numbers of the cloth

    @staticmethod
    def each(value: object, count: int) -> list[float]:
        return [float(value)] * count if isinstance(value, float) else [float(each) for each in value]

    def halves(self, yarn: wy.Yarn) -> tuple[float, float]:
        """Half the width and half the thickness."""
        if yarn.width is not None:
            return yarn.width / 2.0, yarn.thickness / 2.0
        return (yarn.radius or self.cloth.radius,) * 2

    def area(self, yarn: wy.Yarn) -> float:
        """Of the section."""
        return math.pi * math.prod(self.halves(yarn))

    def distance(self, a: tuple[int, int], b: tuple[int, int]) -> float:
        """Of neighbouring crossings (j, i) at rest."""
        return self.along[0][min(a[1], b[1])] if a[0] == b[0] else self.along[1][min(a[0], b[0])]

    def longer(self, where: tuple[int, int], direction: int) -> float:
        """Length of the yarn through a crossing over the distance that it covers."""
        return 1.0 + self.crimp[direction][where[direction]]

    def half_width_across(self, where: tuple[int, int], direction: int) -> float:
        """Of the yarn that crosses one of this direction."""
        j, i = where
        return self.halves((self.weft[i], self.warp[j])[direction])[0]

    def of_nodes(self, name: str) -> Tensor:
        """A number of crossings, of every node."""
        value = getattr(self.cloth, name)
        if isinstance(value, float):
            return torch.full((self.nodes,), value, dtype=torch.float64)
        if value.ndim == 1:
            return tensor(value.copy())
        kinds = len(self.cloth.yarns)
        return tensor([[value[j % kinds][i % kinds] for i in range(self.columns)] for j in range(self.rows)]).ravel()

    # -- where things are

    def node(self, j: int, i: int) -> int:
        return i + j * self.columns

    def unknowns(self, *nodes: int) -> list[int]:
        """Of the positions of nodes."""
        return [3 * node + k for node in nodes for k in range(3)]

    def slide(self, node: int, direction: int) -> int:
        return 3 * self.nodes + 2 * node + direction

    def crossings(self) -> list[tuple[int, int]]:
        return [(j, i) for j in range(1, self.rows - 1) for i in range(1, self.columns - 1)]

    def chains(self, length: int) -> list[tuple[tuple[tuple[int, int], ...], int, wy.Yarn]]:
        """Consecutive crossings (j, i) of one yarn, its direction (0 warp, 1 weft) and its material."""
        warp = [
            (tuple((j, i + k) for k in range(length)), 0, self.warp[j])
            for j in range(self.rows)
            for i in range(self.columns - length + 1)
        ]
        weft = [
            (tuple((j + k, i) for k in range(length)), 1, self.weft[i])
            for i in range(self.columns)
            for j in range(self.rows - length + 1)
        ]
        return warp + weft

    def corners(self) -> list[tuple[tuple[int, int], tuple[int, int], tuple[int, int]]]:
        """(j, i) of a warp neighbour, the crossing and a weft neighbour."""
        return [((j, i + a), (j, i), (j + b, i)) for j, i in self.crossings() for a in (-1, 1) for b in (-1, 1)]

    def triangles(self) -> list[tuple[int, int, int]]:
        """Two to a cell; the diagonal runs to the lower right in even cells."""
        result = []
        for j in range(self.rows - 1):
            for i in range(self.columns - 1):
                a, b = self.node(j, i), self.node(j, i + 1)
                c, d = self.node(j + 1, i), self.node(j + 1, i + 1)
                result += [(a, b, d), (a, d, c)] if (i + j) % 2 == 0 else [(a, b, c), (b, d, c)]
        return result

    def total_mass(self) -> float:
        """Of all yarns: density times length."""
        return sum(yarn.density * self.distance(a, b) * self.longer(a, k) for (a, b), k, yarn in self.chains(2))

    # -- energies

    def _segments(self, local: Callable[..., Tensor], *parameters: list) -> Elements:
        unknowns = []
        for (a, b), direction, _yarn in self.chains(2):
            a, b = self.node(*a), self.node(*b)
            unknowns.append([*self.unknowns(a, b), self.slide(a, direction), self.slide(b, direction)])
        return Elements(torch.tensor(unknowns), local, tuple(tensor(p) for p in parameters))

    def _build(self) -> None:
        """All elements at once: a tensor that is first made inside a transform of torch.func cannot be kept."""
        scene, cloth = self.scene, self.cloth
        yarns = [yarn for *_, yarn in self.chains(2)]
        longer = [self.longer(a, direction) for (a, _), direction, _ in self.chains(2)]
        self.stretch = self._segments(stretch, [yarn.stretch * self.area(yarn) for yarn in yarns], longer)
        self.inertial = self._segments(kinetic, [yarn.density for yarn in yarns])
        self.gravity = self._segments(gravity, [yarn.density for yarn in yarns], [scene.gravity.tolist()] * len(yarns))

        unknowns, k, distance, guard, reach = [], [], [], [], []
        for (a, b), direction, yarn in self.chains(2):
            unknowns.append([self.slide(self.node(*a), direction), self.slide(self.node(*b), direction)])
            against = self.flipped[a[0]][a[1]] != self.flipped[b[0]][b[1]]
            across = self.half_width_across(a, direction) + self.half_width_across(b, direction)
            through = 2.0 * self.halves(yarn)[1] if against else 0.0
            distance.append((across + through) * self.longer(a, direction))
            k.append(cloth.parallel_stiffness * self.distance(a, b))
            guard.append(k[-1] + yarn.stretch * self.area(yarn))
            reach.append(0.1 * across * self.longer(a, direction))
        parameters = (tensor(k), tensor(distance), tensor(guard), tensor(reach))
        self.parallel = Elements(torch.tensor(unknowns), parallel, parameters)

        unknowns, k, l1, l2 = [], [], [], []
        for (a, c, b), direction, yarn in self.chains(3):
            l1.append(self.distance(c, b))
            l2.append(self.distance(a, c))
            a, c, b = self.node(*a), self.node(*c), self.node(*b)
            unknowns.append([*self.unknowns(a, c, b), self.slide(a, direction), self.slide(b, direction)])
            k.append(yarn.bend * self.area(yarn))
        self.bending = Elements(torch.tensor(unknowns), bending, (tensor(k), tensor(l1), tensor(l2)))

        self._build_crimp()
        nodes = [int(node) for node in scene.pins]
        k = tensor([scene.pin_stiffness] * len(nodes))
        self.pins = Elements(
            torch.tensor([self.unknowns(node) for node in nodes]), pin, (k, tensor(cloth.position[nodes]))
        )
        sewn = [[int(node) for node in pair] for pair in scene.seams]
        k = tensor([scene.seam_stiffness] * len(sewn))
        self.seams = Elements(torch.tensor([self.unknowns(*pair) for pair in sewn]), seam, (k,))

    def woven(self, a: tuple[int, int], b: tuple[int, int]) -> list[float]:
        """Distance of two crossings (j, i), and length of the yarn between them, as woven."""
        distance = self.distance(a, b)
        return [distance, distance * self.longer(a, 0 if a[0] == b[0] else 1)]

    def _build_crimp(self) -> None:
        """Crossings, and segments that are straight: of border yarns, and where a yarn stays on one side."""

        def inside(j: int, i: int) -> bool:
            return 0 < j < self.rows - 1 and 0 < i < self.columns - 1

        unknowns, parts, k, b, woven, total = [], [], [], [], [], []
        for j, i in self.crossings():
            near = [(j, i - 1), (j, i + 1), (j - 1, i), (j + 1, i)]
            nodes = [self.node(j, i), *(self.node(*at) for at in near)]
            along = [self.slide(node, direction) for direction in (0, 1) for node in nodes]
            unknowns.append([*self.unknowns(*nodes), *along])
            changes = [self.flipped[at[0]][at[1]] != self.flipped[j][i] for at in near]
            parts.append([0.5 * change if inside(*at) else 1.0 for at, change in zip(near, changes, strict=True)])
            yarns = (self.warp[j], self.weft[i])
            k.append([yarn.stretch * self.area(yarn) for yarn in yarns])
            b.append([yarn.bend * self.area(yarn) for yarn in yarns])
            woven.append([self.woven((j, i), at) for at in near])
            total.append(sum(2.0 * self.halves(yarn)[1] for yarn in yarns))
        parameters = (tensor(parts), tensor(k), tensor(b), tensor(woven), tensor(total))
        self.interchange = Elements(torch.tensor(unknowns), crimped_crossing, parameters)
        k, part, woven = [], [], []
        for (a, c), _direction, yarn in self.chains(2):
            floats = inside(*a) and inside(*c) and self.flipped[a[0]][a[1]] == self.flipped[c[0]][c[1]]
            part.append(float(floats or not (inside(*a) or inside(*c))))
            k.append(yarn.stretch * self.area(yarn))
            woven.append(self.woven(a, c))
        self.straight = self._segments(straight_segment, k, part, woven)

    def shear(self, contact_force: Tensor) -> Elements:
        """F_n of every node is held."""
        unknowns, jams, crossing, area, l1, l2, threshold = [], [], [], [], [], [], []
        for corner in self.corners():
            p, c, r = (self.flipped[j][i] for j, i in corner)
            nodes = [self.node(*where) for where in corner]
            unknowns.append(self.unknowns(*nodes))
            jams.append(c != p and c != r)
            crossing.append(nodes[1])
            area.append(math.pi * self.half_width_across(corner[1], 0) * self.half_width_across(corner[1], 1))
            # the weft yarns at the crossing and at p are as far apart as these, the warp yarns as it and r
            l1.append(self.distance(corner[0], corner[1]))
            l2.append(self.distance(corner[1], corner[2]))
            wefts = [self.half_width_across(where, 0) for where in corner[:2]]
            warps = [self.half_width_across(where, 1) for where in corner[1:]]
            threshold.append(math.asin(sum(wefts) / 2.0 / l1[-1]) + math.asin(sum(warps) / 2.0 / l2[-1]))
        l1, l2, threshold = tensor(l1), tensor(l2), tensor(threshold)
        k = self.of_nodes("shear")[crossing] * tensor(area) * (l1 + l2) / 2.0 * (1.0 + contact_force[crossing])
        parameters = (k, torch.tensor(jams), l1, l2, threshold, 1.0 / torch.sin(threshold / 2.0))
        return Elements(torch.tensor(unknowns), shear, parameters)

    def elements(self, term: str, q: Tensor) -> Elements:
        """Of a conservative term; the contact force is that of q."""
        return self.shear(self.contact(q)[1].detach()) if term == "shear" else getattr(self, term)

    # -- inertia

    def kinetic(self, q: Tensor, v: Tensor) -> Tensor:
        e = self.inertial
        return vmap(kinetic)(q[e.unknowns], v[e.unknowns], *e.parameters).sum()

    def mass(self, q: Tensor, v: Tensor) -> Tensor:
        e = self.inertial
        blocks = vmap(hessian(kinetic, argnums=1))(q[e.unknowns], v[e.unknowns], *e.parameters)
        return e.matrix(blocks, self.size)

    # -- contact

    def contact(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Normal [nodes, 3] and F_n [nodes], eq. 3; what the scene's terms press with."""
        x = q[: 3 * self.nodes].reshape(self.nodes, 3)
        at, left, right, up, down = (
            [self.node(j + b, i + a) for j, i in self.crossings()]
            for a, b in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
        )
        points = x[torch.tensor([at, left, right, up, down])]
        centered = points - points.mean(dim=0)
        covariance = torch.einsum("pca,pcb->cab", centered, centered)
        n = torch.linalg.eigh(covariance)[1][:, :, 0]
        a, b = x[right] - x[left], x[down] - x[up]
        side = torch.sum(n * torch.linalg.cross(a, b), dim=1)
        sine = side.abs() / (torch.linalg.vector_norm(a, dim=1) * torch.linalg.vector_norm(b, dim=1))
        y = torch.clamp(sine / 0.05, max=1.0)
        n = n * (6.0 * y**5 - 15.0 * y**4 + 10.0 * y**3)[:, None]
        sign = torch.where(side < 0.0, -1.0, 1.0)
        sign = sign * tensor([-1.0 if self.flipped[j][i] else 1.0 for j, i in self.crossings()])
        normal = torch.zeros_like(x).index_put((torch.tensor(at),), n * sign.detach()[:, None])

        load = torch.zeros(self.nodes, dtype=torch.float64)
        crimped = self.scene.contact_force == "crimped"
        for term, length in (("stretch", 2), ("bending", 3)):
            if term not in self.scene.terms or self.scene.crimp_interchange:
                continue
            for direction, sign in ((0, 1.0), (1, -1.0)):
                which = [d == direction for _, d, _ in self.chains(length)]
                yarns = getattr(self, term).of(which)
                half = tensor([self.offset(j, i, direction) for j in range(self.rows) for i in range(self.columns)])
                crimp = -sign * half[:, None] * normal if term == "bending" or crimped else torch.zeros_like(x)
                moved = torch.cat([(x + crimp).ravel(), q[3 * self.nodes :]])
                if term == "stretch" and crimped:
                    force = self.turned(yarns, q, moved)
                else:
                    force = yarns.force(moved)[: 3 * self.nodes].reshape(self.nodes, 3)
                load = load + 0.5 * sign * torch.sum(normal * force, dim=1)
        if "crimp_interchange" in self.scene.terms:
            load = load + self.interchange_load(q, normal)
        return normal, torch.relu(load)

    def offset(self, j: int, i: int, direction: int) -> float:
        """How far from its node a yarn passes at a crossing: its half thickness, or half the height of its crimp."""
        if self.scene.contact_force == "published":
            return self.halves((self.warp[j], self.weft[i])[direction])[1]
        distance = sum(self.along[direction]) / len(self.along[direction])
        crimp = self.longer((j, i), direction) - 1.0
        return 2.0 / 3.0 * distance * math.sqrt(crimp + 0.5 * crimp**2)

    def turned(self, yarns: Elements, q: Tensor, moved: Tensor) -> Tensor:
        """Forces of stretch [nodes, 3], each turned into the direction of its segment between moved positions."""
        force = torch.zeros(self.nodes, 3, dtype=torch.float64)
        pull = -vmap(grad(yarns.local))(q[yarns.unknowns], *yarns.parameters)[:, 0:3]
        d = q[yarns.unknowns][:, 3:6] - q[yarns.unknowns][:, 0:3]
        along = moved[yarns.unknowns][:, 3:6] - moved[yarns.unknowns][:, 0:3]
        size = torch.sum(pull * d, dim=1) / torch.linalg.vector_norm(d, dim=1)
        pull = size[:, None] * along / torch.linalg.vector_norm(along, dim=1)[:, None]
        a, b = yarns.unknowns[:, 0] // 3, yarns.unknowns[:, 3] // 3
        return force.index_add(0, a, pull).index_add(0, b, -pull)

    def interchange_load(self, q: Tensor, normal: Tensor) -> Tensor:
        """What holds h₁ + h₂, 2 ∂W/∂(d₁ + d₂), and half the difference of what warp and weft pull with."""
        e = self.interchange
        holds = 2.0 * vmap(grad(e.local, argnums=5))(q[e.unknowns], *e.parameters)
        load = torch.zeros(self.nodes, dtype=torch.float64).index_add(0, e.unknowns[:, 0] // 3, holds)

        def by_p(q: Tensor, *parameters: Tensor) -> Tensor:
            p, rest = segments_of(q)
            return grad(crossing_of_lengths)(p, rest, *parameters)

        # on the crossing and its four neighbours
        x = q[e.unknowns][:, :15].reshape(-1, 5, 3)
        d = x[:, 1:] - x[:, :1]
        pull = vmap(by_p)(q[e.unknowns], *e.parameters)[:, :, None] * d / torch.linalg.vector_norm(d, dim=2)[:, :, None]
        nodes = e.unknowns[:, :15:3] // 3
        for direction, half in ((0, 0.5), (1, -0.5)):
            force = self.straight.of([d == direction for _, d, _ in self.chains(2)]).force(q)
            force = force[: 3 * self.nodes].reshape(self.nodes, 3)
            for side in (2 * direction, 2 * direction + 1):
                force = force.index_add(0, nodes[:, 0], pull[:, side]).index_add(0, nodes[:, side + 1], -pull[:, side])
            load = load + half * torch.sum(normal * force, dim=1)
        return load

    # -- forces

    def force(self, term: str, q: Tensor, v: Tensor, anchor: Tensor) -> Tensor:
        """[5 nodes]; nothing on (u, v) where nothing slides."""
        force = getattr(self, f"_{term}_force", None)
        result = force(q, v, anchor) if force else getattr(self, term).force(q)
        x, s = result[: 3 * self.nodes], result[3 * self.nodes :]
        return torch.cat([x, s * self.slides])

    def _crimp_interchange_force(self, q: Tensor, *_: Tensor) -> Tensor:
        return self.interchange.force(q) + self.straight.force(q)

    def _shear_force(self, q: Tensor, *_: Tensor) -> Tensor:
        return self.shear(self.contact(q)[1]).force(q)

    def _inertia_force(self, q: Tensor, v: Tensor, *_: Tensor) -> Tensor:
        return grad(self.kinetic)(q, v)

    def _mass_rate_force(self, q: Tensor, v: Tensor, *_: Tensor) -> Tensor:
        return -jvp(lambda q: grad(self.kinetic, argnums=1)(q, v), (q,), (v,))[1]

    def _wind_force(self, q: Tensor, v: Tensor, *_: Tensor) -> Tensor:
        w = self.scene.wind
        unknowns = torch.tensor([self.unknowns(*nodes) for nodes in self.triangles()])
        velocity = tensor(w.velocity)
        forces = vmap(lambda q, v: wind(q, v, velocity, w.density, w.drag))(q[unknowns], v[unknowns])
        return torch.zeros_like(q).index_put((unknowns,), forces, accumulate=True)

    def _applied_force(self, q: Tensor, *_: Tensor) -> Tensor:
        unknowns = torch.tensor([self.unknowns(int(node)) for node in self.scene.force_nodes])
        return torch.zeros_like(q).index_put((unknowns,), tensor(self.scene.force_path[0]), accumulate=True)

    def _friction_force(self, q: Tensor, v: Tensor, anchor: Tensor) -> Tensor:
        others = sum(self.force(t, q, v, anchor) for t in self.scene.terms if t not in ("mass", "friction"))
        others = others[3 * self.nodes :] if isinstance(others, Tensor) else torch.zeros_like(anchor)
        delta = q[3 * self.nodes :] - anchor
        limit = (self.of_nodes("friction") * self.contact(q)[1]).repeat_interleave(2)
        spring = self.spring(delta, others, limit)
        f = spring - self.of_nodes("friction_damping").repeat_interleave(2) * v[3 * self.nodes :]
        return torch.cat([torch.zeros_like(q[: 3 * self.nodes]), f])

    def spring(self, delta: Tensor, others: Tensor, limit: Tensor) -> Tensor:
        """Eq. 4 without damping; limit = μF_n."""
        k, p = self.of_nodes("friction_stiffness").repeat_interleave(2), self.cloth.friction_sharpness
        # The floor under μF_n: the spring's force at 1e-7 spacings, to the next crossing of the warp yarn.
        spacing = tensor([self.along[0][min(i, self.columns - 2)] for i in range(self.columns)])
        floor = k * spacing.repeat(self.rows).repeat_interleave(2) * 1e-7
        scale = torch.ones_like(limit) if self.scene.published_scaling else limit + floor
        per_length = 1.0 if self.scene.published_scaling else k
        sign = torch.tanh(p * delta * per_length / scale)
        stuck = torch.tanh(p * (limit - torch.abs(others)) / scale)
        held = k * delta
        if not self.scene.published_scaling:
            # the integral of a slope that falls from 1 to 0 between 0.9 and 1.1 of the limit
            over = torch.clamp(torch.abs(held) - 0.9 * limit, min=0.0)
            over = torch.minimum(over, 0.2 * limit)
            bent = over - over**2 / torch.where(limit > 0.0, 0.4 * limit, 1.0)
            held = torch.sign(delta) * (torch.minimum(torch.abs(held), 0.9 * limit) + bent)
        return -(0.5 * (held - sign * limit) * stuck + 0.5 * (held + sign * limit))
