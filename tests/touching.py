"""Cloths that touch something, and the law of contact a second time, in torch float64, from its formulas alone."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import torch
from internals import numbers
from reference import Tensor, tensor
from scipy.spatial.transform import Rotation

import warp_yarn as wy

YARNS = wy.paper.cloth(rows=3, columns=3).yarns
GROUND = wy.Plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
TURNED = Rotation.from_rotvec((0.7, -0.4, 1.1))
QUATERNION = TURNED.as_quat()


def paper(rows: int, columns: int, *, pose: str = "flat", weave: str = "plain") -> wy.Cloth:
    """The paper's cloth, of any size."""
    return wy.Cloth(wy.WEAVES[weave](rows=rows, columns=columns), yarns=YARNS, pose=pose)


def lifted(cloth: wy.Cloth, by: float, jitter: float = 0.0, seed: int = 0) -> wy.Cloth:
    """A cloth in its pose, higher by so much, with every node put elsewhere by up to ``jitter``."""
    random = np.random.default_rng(seed)
    position = cloth.position + (0.0, 0.0, by) + jitter * random.uniform(-1.0, 1.0, cloth.position.shape)
    return cloth.replace(pose=position)


def posed(cloth: wy.Cloth, position: np.ndarray, velocity: np.ndarray | float = 0.0) -> wy.State:
    """A state of a cloth with its crossings where they are at rest."""
    zero = np.zeros_like(cloth.euler)
    return wy.State(position, cloth.euler.copy(), np.zeros_like(position) + velocity, zero)


def folded(
    rows: int = 4, columns: int = 17, *, radius: float = 1.6e-3, jitter: float = 2e-5, seed: int = 1
) -> wy.Cloth:
    """A strip whose one end lies over the other, twice the radius above it, just over z = 0."""
    base = paper(rows, columns)
    u = base.position[:, 0]
    begin = 0.5 * u.max() - 0.5 * np.pi * radius
    along = np.clip((u - begin) / radius, 0.0, np.pi)
    x = np.where(u < begin, u, begin + radius * np.sin(along) - np.maximum(u - begin - np.pi * radius, 0.0))
    z = radius * (1.0 - np.cos(along)) + 1.6e-3
    position = np.stack([x, base.position[:, 1], z], axis=1)
    return base.replace(pose=position + jitter * np.random.default_rng(seed).standard_normal(position.shape))


def far_apart(cloth: wy.Cloth, simulator: wy.Simulator) -> np.ndarray:
    """Which nodes are so far apart along the cloth that they may touch [nodes, nodes]."""
    touch = sum(float(numbers(simulator, f"self_contact_{name}")[0]) for name in ("distance", "range"))
    rest = np.linalg.norm(cloth.rest_place[:, None] - cloth.rest_place[None], axis=2)
    return rest >= 0.5 * np.pi * touch


def middles(rows: int, columns: int) -> np.ndarray:
    """What samples are of nodes, middles of all segments too [samples, nodes]: by rows and columns."""
    node = np.arange(rows * columns).reshape(rows, columns)
    ends = [(node[:, :-1], node[:, 1:]), (node[:-1], node[1:])]
    first, second = (np.concatenate([pair[k].ravel() for pair in ends]) for k in (0, 1))
    each = np.eye(rows * columns)
    return np.concatenate([each, 0.5 * (each[first] + each[second])])


def gaps_of_pairs(cloth: wy.Cloth, simulator: wy.Simulator, position: np.ndarray) -> np.ndarray:
    """Distances of all pairs that may touch, each once [pairs]."""
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    return distance[np.triu(far_apart(cloth, simulator), 1)]


# -- distances, in the world's coordinates -----------------------------------------------------------------------------


def closest_on_segment(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    t = (((x - a) @ (b - a)) / ((b - a) @ (b - a))).clamp(0.0, 1.0)
    return a + t[:, None] * (b - a)


def to_triangle(x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """The least of the distances to corners, edges and, where x is over it, the face."""
    sides = [torch.linalg.vector_norm(x - closest_on_segment(x, *ends), dim=1) for ends in ((a, b), (b, c), (c, a))]
    normal = torch.linalg.cross(b - a, c - a)
    unit = normal / torch.linalg.vector_norm(normal)
    over = torch.ones(len(x), dtype=torch.bool)
    for start, end in ((a, b), (b, c), (c, a)):
        over &= (torch.linalg.cross((end - start).expand_as(x), x - start) @ normal) >= 0.0
    height = ((x - a) @ unit).abs()
    return torch.where(over, height, torch.stack(sides).min(dim=0).values)


def to_box(x: Tensor, center: Tensor, half: Tensor, axes: Tensor) -> Tensor:
    """axes: of the box, as rows."""
    along = (x - center) @ axes.T
    return torch.linalg.vector_norm(along - along.clamp(-half, half), dim=1)


def to_cylinder(x: Tensor, start: Tensor, end: Tensor, radius: float) -> Tensor:
    length = torch.linalg.vector_norm(end - start)
    axis = (end - start) / length
    along = (x - start) @ axis
    aside = x - start - along[:, None] * axis
    rho = torch.linalg.vector_norm(aside, dim=1)
    closest = start + along.clamp(0.0, float(length))[:, None] * axis + aside * (rho.clamp(max=radius) / rho)[:, None]
    return torch.linalg.vector_norm(x - closest, dim=1)


ICOSAHEDRON = (
    np.array([(0, 1, 1.618), (0, -1, 1.618), (0, 1, -1.618), (0, -1, -1.618), (1, 1.618, 0), (-1, 1.618, 0),
              (1, -1.618, 0), (-1, -1.618, 0), (1.618, 0, 1), (-1.618, 0, 1), (1.618, 0, -1), (-1.618, 0, -1)]) * 1e-3,
    np.array([(0, 1, 8), (0, 8, 4), (0, 4, 5), (0, 5, 9), (0, 9, 1), (1, 6, 8), (8, 6, 10), (8, 10, 4), (4, 10, 2),
              (4, 2, 5), (5, 2, 11), (5, 11, 9), (9, 11, 7), (9, 7, 1), (1, 7, 6), (3, 6, 7), (3, 7, 11), (3, 11, 2),
              (3, 2, 10), (3, 10, 6)]),
)  # fmt: skip


def shapes(friction: float = 0.3) -> dict[str, tuple[wy.Obstacle, Callable[[Tensor], Tensor]]]:
    """Every shape, turned and out of the origin, and its distance from places [places, 3]."""
    at, axes = np.array([1e-3, -2e-3, 3e-3]), tensor(TURNED.as_matrix().T)
    end = at + TURNED.apply((0.0, 0.0, 5e-3))
    normal = TURNED.apply((0.0, 0.0, 1.0))
    half = np.array([2e-3, 3e-3, 1e-3])
    vertices, faces = ICOSAHEDRON
    options = {"friction": friction}
    p, q = tensor(at), tensor(end)
    return {
        "plane": (wy.Plane(point=at, normal=3.0 * normal, **options), lambda x: (x - p) @ tensor(normal)),
        "sphere": (
            wy.Sphere(center=at, radius=2e-3, **options),
            lambda x: torch.linalg.vector_norm(x - p, dim=1) - 2e-3,
        ),
        "capsule": (
            wy.Capsule(start=at, end=end, radius=1e-3, **options),
            lambda x: torch.linalg.vector_norm(x - closest_on_segment(x, p, q), dim=1) - 1e-3,
        ),
        "cylinder": (wy.Cylinder(start=at, end=end, radius=2e-3, **options), lambda x: to_cylinder(x, p, q, 2e-3)),
        "box": (
            wy.Box(center=at, half_extents=half, rotation=QUATERNION, **options),
            lambda x: to_box(x, p, tensor(half), axes),
        ),
        "mesh": (
            wy.TriangleMesh(vertices, faces, position=at, rotation=QUATERNION, **options),
            lambda x: torch.stack([distance(x) for distance in faces_of_mesh()]).min(dim=0).values,
        ),
    }


def faces_of_mesh() -> list[Callable[[Tensor], Tensor]]:
    """Distances from each face of the mesh among ``shapes``, all of which push."""
    vertices, faces = ICOSAHEDRON
    corners = tensor(TURNED.apply(vertices) + np.array([1e-3, -2e-3, 3e-3]))
    return [functools.partial(to_triangle, a=a, b=b, c=c) for a, b, c in (corners[list(face)] for face in faces)]


def parts_of(name: str) -> list[Callable[[Tensor], Tensor]]:
    """What pushes of one of ``shapes``: itself, or each of its faces."""
    return faces_of_mesh() if name == "mesh" else [shapes()[name][1]]


SHAPES = ("plane", "sphere", "capsule", "cylinder", "box", "mesh")


# -- the law -----------------------------------------------------------------------------------------------------------


class Law:
    """What a contact does, from its formulas.

    Args:
        stiffness, distance, range, slip_speed, damping_speed: κ, D, d̂, ε, v_d.
        friction: μ.
    """

    def __init__(self, stiffness, distance, range, slip_speed, damping_speed, friction):
        self.stiffness, self.distance, self.range = stiffness, distance, range
        self.slip_speed, self.damping_speed, self.friction = slip_speed, damping_speed, friction

    def energy(self, gap: Tensor) -> Tensor:
        """Of every gap."""
        x = ((gap - self.distance) / self.range).clamp(max=1.0)
        return -self.stiffness * self.range**2 * (1.0 - x) ** 2 * torch.log(x)

    def force(self, gap: Tensor, n: Tensor, v: Tensor) -> Tensor:
        """On what moves at v relative to the other side, n away from it."""
        x = ((gap - self.distance) / self.range).clamp(max=1.0)
        slope = self.stiffness * self.range * (2.0 * (1.0 - x) * torch.log(x) - (1.0 - x) ** 2 / x)
        approach = -(n * v).sum(dim=-1)
        y = approach / self.damping_speed
        load = -slope * (y + torch.sqrt(y * y + 4.0)) / 2.0
        across = v + approach[..., None] * n
        speed = torch.sqrt((across * across).sum(dim=-1) + 1e-60)
        part = (speed / self.slip_speed).clamp(max=1.0)
        mobilized = 2.0 * part - part**2
        return load[..., None] * n - (self.friction * load * mobilized / speed)[..., None] * across


def law_of(simulator: wy.Simulator, friction: float, kind: str = "contact") -> Law:
    names = ("stiffness", "distance", "range", "slip_speed", "damping_speed")
    return Law(*(float(numbers(simulator, f"{kind}_{name}")[0]) for name in names), friction)


def places_near(distance: Callable[[Tensor], Tensor], count: int, low: float, high: float, seed: int = 0) -> np.ndarray:
    """Random places whose distance is between these, above 0."""
    random, found = np.random.default_rng(seed), np.zeros((0, 3))
    while len(found) < count:
        places = random.uniform(-12e-3, 12e-3, (4000, 3))
        gap = distance(tensor(places)).numpy()
        found = np.concatenate([found, places[(gap > low) & (gap < high)]])
    return found[:count]


def gradient(distance: Callable[[Tensor], Tensor], places: np.ndarray) -> tuple[Tensor, Tensor]:
    """Distances of places, and their gradient, by automatic differentiation."""
    x = tensor(places).clone().requires_grad_()
    gap = distance(x)
    (n,) = torch.autograd.grad(gap.sum(), x)
    return gap.detach(), n
