"""A term from outside the package: a drag on yarns that is linear in their velocity.

    python examples/linear_drag.py

    F = −c Δs ẋ, half of it on each end of a segment

Parameters: ``linear_drag`` c [N s/m²]. The matrix holds c, the exact derivative by velocity. There is no energy.
A falling cloth of one yarn stays as it is, and its velocity is g τ (1 − exp(−t/τ)), τ = ρ/c.
"""

import numpy as np
import warp as wp
from warp_yarn.kernels.core.indexing import coordinates, index

import warp_yarn as wy
import warp_yarn.torch as wt


def define(variant: wy.Variant) -> wp.Kernel:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33

    @variant.kernel("terms")
    def linear_drag_term(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        linear_drag: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        momentum: wp.array(dtype=vec3),
        matrix: int,
        coefficients: wp.array(dtype=vec3),
        diagonal_xx: wp.array(dtype=mat33),
    ):
        e = index(wp.tid())
        sa, sb = coordinates(segment_nodes, segment_yarn, yarn_direction, e)
        c = scalar(0.5) * linear_drag[0] * (euler[sb] - euler[sa])
        for end in range(2):
            i = index(segment_nodes[e][end])
            wp.atomic_add(force, i, velocity[i] * (-c))
            if matrix != 0:
                wp.atomic_add(momentum, i, velocity[i] * (coefficients[0][1] * c))
                wp.atomic_add(diagonal_xx, i, wp.identity(n=3, dtype=scalar) * (coefficients[0][1] * c))

    return linear_drag_term


C = wy.TermParameter("linear_drag", "N s/m²", least=0.0)
wy.register_term(wy.Term("linear_drag", "segments", define, parameters=(C,), explicit_in_ros2=True))


def main() -> dict[str, float]:
    fabric = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    tau = 0.02
    scene = wy.Scene(fabric, parameters={"linear_drag": fabric.yarns[0].density / tau})
    velocity = wy.Simulator(scene).run(200).velocity[-1, :, 2].mean()
    terminal = -9.8 * tau * (1.0 - np.exp(-0.2 / tau))
    print(f"falls at {velocity:.6f} m/s after 0.2 s, {terminal:.6f} by the closed form")

    rollout = wt.Rollout(scene, 20, frames=[20])
    c = rollout.defaults["linear_drag"].requires_grad_()
    rollout(linear_drag=c).velocity[0, :, 2].mean().backward()
    near = [float(rollout(linear_drag=x).velocity[0, :, 2].mean()) for x in (c.detach() * 1.001, c.detach() * 0.999)]
    difference = (near[0] - near[1]) / (0.002 * float(c.detach()))
    print(f"d velocity/dc is {c.grad:.7f}, {difference:.7f} by central differences")
    return {"velocity": velocity, "terminal": terminal, "gradient": float(c.grad), "difference": difference}


if __name__ == "__main__":
    main()
