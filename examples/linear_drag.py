"""A term from outside the package: a drag on yarns that is linear in their velocity.

    python examples/linear_drag.py

    F = −c Δs ẋ, half of it on each end of a segment

Parameters: ``linear_drag`` c [N s/m²]. The matrix holds c, the exact derivative by velocity. There is no energy.
A falling cloth of one yarn stays as it is, and its velocity is g τ (1 − exp(−t/τ)), τ = ρ/c.
"""

import numpy as np
import warp as wp
from warp_yarn.kernels.core.indexing import ends, index
from warp_yarn.kernels.core.structs import structs

import warp_yarn as wy
import warp_yarn.torch as wt


def define(variant: wy.Variant) -> wp.Kernel:
    scalar, vec3, BlockMatrix = variant.scalar, variant.vec3, structs(variant).BlockMatrix

    @variant.kernel("terms")
    def linear_drag_term(
        segments: wp.array(dtype=wp.vec4i),
        linear_drag: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        momentum: wp.array(dtype=vec3),
        matrix: int,
        blocks: BlockMatrix,
    ):
        a, b, sa, sb, _yarn, _direction = ends(segments, index(wp.tid()))
        c = scalar(0.5) * linear_drag[0] * (euler[sb] - euler[sa])
        wp.atomic_add(force, a, velocity[a] * (-c))
        wp.atomic_add(force, b, velocity[b] * (-c))
        if matrix != 0:
            damping = blocks.coefficients[0][1] * c
            wp.atomic_add(momentum, a, velocity[a] * damping)
            wp.atomic_add(momentum, b, velocity[b] * damping)
            wp.atomic_add(blocks.diagonal_xx, a, wp.identity(n=3, dtype=scalar) * damping)
            wp.atomic_add(blocks.diagonal_xx, b, wp.identity(n=3, dtype=scalar) * damping)

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
