"""A method of time integration from outside the package, given by its Butcher tableau.

    python examples/butcher_tableau.py

The other two-stage, stiffly accurate SDIRK method of order 2: γ = 1 + 1/√2, where "sdirk2" has 1 − 1/√2. Both are
L-stable; its error is larger, as its first stage looks far beyond the step.
"""

import math

import numpy as np

import warp_yarn as wy

GAMMA = 1.0 + math.sqrt(0.5)
METHOD = wy.sdirk("sdirk2-far", a=[[GAMMA, 0.0], [1.0 - GAMMA, GAMMA]], b=[1.0 - GAMMA, GAMMA])
wy.register_integrator(METHOD)


def swung(integrator: str, step: float) -> np.ndarray:
    """Positions after 16 ms of a small cloth that hangs in the wind and is too soft to vibrate within a step."""
    soft = wy.Yarn(density=2e-3, stretch=100.0, bend=1.4e-4)
    options = {"radius": 2.4e-4, "shear": 1.0, "friction_damping": 0.1, "friction_stiffness": 1.0}
    fabric = wy.Cloth(wy.Weave.plain(rows=4, columns=4), yarns=[soft], **options)
    scene = wy.Scene(fabric, pins=fabric.corners("top"), pin_stiffness=0.01, wind=wy.Wind(velocity=(0.0, 1.0, 0.0)))
    simulator = wy.Simulator(scene, step=step, integrator=integrator, newton_tolerance=1e-10)
    return simulator.run(round(0.016 / step)).position[-1]


def main() -> dict[str, list[float]]:
    steps = [0.5e-3, 0.25e-3, 0.125e-3]
    reference = swung("sdirk2", 1e-3 / 64)
    errors = {}
    for name in ("sdirk2-far", "sdirk2"):
        errors[name] = [float(np.abs(swung(name, step) - reference).max()) for step in steps]
        orders = ", ".join(f"{math.log2(a / b):.2f}" for a, b in zip(errors[name], errors[name][1:], strict=False))
        print(f"{name}: errors {', '.join(f'{error:.2e}' for error in errors[name])} m, orders {orders}")
    return errors


if __name__ == "__main__":
    main()
