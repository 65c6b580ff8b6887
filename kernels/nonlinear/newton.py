"""Newton's iteration on an implicit stage (``stepping/dirk.py``): its start, its control and when to take a new matrix.

It takes A, the symmetric positive definite part of −∂r/∂w, for its matrix: M + η D + η² H. After its first step it
takes A − G where yarns are compressed (``linear/beside.py``), as long as that is positive definite, each time at the
state that it has come to. (Only where it went on slowly, and with the first matrix until then, handkerchiefs and cotton
took a fifth more iterations and a tenth more time; from the first step on, A − G is often indefinite.)
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import ends, index
from ..core.memory import functions as access
from ..core.status import NOT_FINITE, STALLED
from ..core.structs import structs
from ..core.variant import Variant

NOTHING, OBSTACLES, PINS = 0, 1, 2
"""What may hold a cloth; obstacles hold it where it touches them."""
MOST_EVALUATIONS = 200
"""Evaluations in a stage. Newton's iteration takes 2 or 3 in ordinary motion; A leaves out what is not symmetric, so
that violent sliding brings them to dozens."""
SHORTEST_STEP_LENGTH = 2.0**-24
"""Of the line search: where crossings nearly touch, or l and Δs shrink together, which costs next to no energy, it must
be short indeed."""
OVERSHOOT = 0.9
"""Part of the slope that a step of the iteration may turn to with the other sign (``integrators/stage.py``)."""
CONTRACTION_SAFETY = 4.0
"""What a step of the iteration leaves is taken to be so many times what the contraction before it says."""
STEADY_CONTRACTION = 0.97
"""The most that is believed. Where A − G is indefinite, and by friction, which is not symmetric, steps fall by a steady
factor, and all that are still to come add up to a geometric series. To go on until rounding ends it took three quarters
of all iterations of a cloth that was let go from 15 % stretch."""
LEAST_CONTRACTION = 1e-3
"""The least contraction that is believed: a cloth that moves as one is solved at once, and what comes next is not."""
REBUILDING_TURN = 0.03
"""Angle by which a yarn turns in a step, above which its second stage has a matrix of its own: below 0.025, one
iteration did with that of the first stage, above 0.045, two to seven, and one or two with its own (17 × 17)."""
ROUNDING_MARGIN = 10.0
"""Times the rounding of positions that a residual may end with where no step takes more of it away."""
POSITION_ROUNDING = {wp.float64: 1e-15, wp.float32: 5e-7}
"""A few units in the last place."""


@wp.func
def is_held(held_by: int, touching: wp.array(dtype=int)) -> bool:
    """Tell whether anything keeps the mass centre of all cloth from moving as outer forces have it."""
    return held_by == wp.static(PINS) or (held_by == wp.static(OBSTACLES) and touching[0] != 0)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    load, store = access(variant).load, access(variant).store
    NewtonControl = structs(variant).NewtonControl
    module = variant.module("stage")

    @wp.kernel(module=module, enable_backward=False)
    def start_rigid(
        nodes: int,
        held_by: int,
        touching: wp.array(dtype=int),
        node_mass: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
    ):
        """Start δ as that of a free cloth that moves as one: the solver need not find how it falls, to its
        tolerance."""
        if is_held(held_by, touching):
            return
        momentum = vec3()
        mass = scalar(0.0)
        for i in range(nodes):
            momentum += load(rhs, i)
            mass += load(node_mass, i)
        for i in range(nodes):
            store(direction, i, momentum / mass)

    @wp.kernel(module=module, enable_backward=False)
    def check_convergence(
        stage: int,
        touching: wp.array(dtype=int),
        residual: wp.array(dtype=scalar),
        control: NewtonControl,
        status: wp.array(dtype=int),
    ):
        """Choose whether the step along δ is the last one: what it leaves is small beside how much velocities change.

        ‖δ‖ is in the norm of A, √(δ·A δ) = √(r·δ), which is more than that of M, and the change in that of M: kinetic
        energy. (Of A − G it might be less.) What it leaves is taken from the contraction.
        """
        norm = wp.sqrt(wp.max(control.directional_derivative[0], control.kinetic_left[0]))
        # not of the first δ, of which the line search may take little
        change = wp.sqrt(control.kinetic[0])
        if stage == 0:
            control.first_change[0] = change
        else:
            change = wp.max(change, control.first_change[0])
        control.change[0] = change
        left = scalar(CONTRACTION_SAFETY)
        if control.steps[0] > 0:
            before = control.last_norm[0]
            if control.steps[0] > 1:
                # a step that went astray is large, and the one after it no nearer to the end than the one before
                before /= wp.max(control.contraction[0], scalar(1.0))
            # of a first step that stretches yarns, more is taken away at once than by those after it
            before = wp.max(wp.min(before, change), scalar(1.0e-30))
            control.contraction[0] = wp.max(norm / before, scalar(LEAST_CONTRACTION))
            left *= control.contraction[0]
        elif stage == 0:
            # not known of a time step's first
            left = scalar(1.0)
        else:
            # that of the stage before, whose matrix this one begins with
            left *= control.contraction[0] * scalar(CONTRACTION_SAFETY)
        control.steps[0] = control.steps[0] + 1
        control.last_norm[0] = norm
        control.newton_iterations[0] = control.newton_iterations[0] + 1
        if status[0] == 0:
            residual[0] = norm / wp.max(change, scalar(1.0e-30))
        control.take_unchecked_step[0] = 0
        least = control.newton_tolerance[0] * change
        small = left < scalar(1.0) and left * norm <= least
        rest = scalar(1.0) - control.contraction[0]
        if control.steps[0] > 1 and rest > scalar(wp.static(1.0 - STEADY_CONTRACTION)):
            small = small or left * norm <= rest * least
        if norm == scalar(0.0) or (control.step_length[0] == scalar(1.0) and small):
            control.take_unchecked_step[0] = 1
        if -control.directional_derivative[0] > least * least and status[0] == 0:
            # a direction along which r does not fall: the linear solve has no digit right
            status[0] = wp.static(STALLED)
            status[1] = -1

    @wp.func
    def norms(
        nodes: int,
        is_free: wp.array(dtype=int),
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
    ):
        """Add up ‖r‖, what the rounding of 1 in positions makes of it, and r·δ, of what is free.

        ‖r‖ is in the norm of A's inverse diagonal, the mean of each node's, so that it is the same in every frame.
        """
        one = scalar(1.0)
        turned = scalar(0.0)
        of_rhs = scalar(0.0)
        of_rounding = scalar(0.0)
        for i in range(nodes):
            inverse = load(inverse_x, i)
            r = load(rhs, i)
            if inverse[0] > scalar(0.0) and inverse[1] > scalar(0.0) and inverse[2] > scalar(0.0):
                x = load(position, i)
                stiffness = (one / inverse[0] + one / inverse[1] + one / inverse[2]) * scalar(wp.static(1.0 / 3.0))
                of_rhs += wp.dot(r, r) / stiffness
                of_rounding += wp.dot(x, x) * stiffness
                turned += wp.dot(r, load(direction, i))
            elif is_free[i] != 0:
                # a matrix without bounds: nothing here means anything
                of_rhs += scalar(wp.static(float("inf")))
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    inverse_along = load(inverse_s, s)
                    if inverse_along > scalar(0.0):
                        r_s = load(euler_rhs, s)
                        of_rhs += inverse_along * r_s * r_s
                        of_rounding += load(euler, s) * load(euler, s) / inverse_along
                        turned += r_s * load(euler_direction, s)
        return wp.sqrt(of_rhs), wp.sqrt(of_rounding), turned

    @wp.func
    def not_finite(
        nodes: int, is_free: wp.array(dtype=int), rhs: wp.array(dtype=vec3), inverse_x: wp.array(dtype=vec3)
    ) -> int:
        """Find a node whose residual or matrix is not finite, or -1."""
        found = int(-1)
        for i in range(nodes):
            if is_free[i] != 0 and not (wp.isfinite(rhs[i]) and wp.min(inverse_x[i]) > scalar(0.0)):
                found = i
        return found

    @wp.kernel(module=module, enable_backward=False)
    def control_newton(
        nodes: int,
        is_free: wp.array(dtype=int),
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        control: NewtonControl,
        status: wp.array(dtype=int),
    ):
        """Choose what is next at w: to stop, to iterate, to halve the step of the line search, or to fail."""
        now, rounding, turned = norms(
            nodes, is_free, inverse_x, inverse_s, rhs, euler_rhs, direction, euler_direction, position, euler
        )
        # velocities that positions are too coarse to tell from 0
        rounding *= scalar(wp.static(POSITION_ROUNDING[scalar])) / stage_size[0]
        before = control.residual_norm[0]
        first = control.evaluations[0] == 0
        control.evaluations[0] = control.evaluations[0] + 1
        control.iterate[0] = 1
        control.new_direction[0] = 1
        control.rebuild_matrix[0] = 0
        stalled = control.evaluations[0] > wp.static(MOST_EVALUATIONS)
        ordered = bool(True)
        if wp.static(sliding):
            ordered = control.shortest[0] > scalar(0.0)
            control.shortest[0] = scalar(wp.static(1.0e30))
        if first or (ordered and (now < before or turned > scalar(-OVERSHOOT) * control.directional_derivative[0])):
            if not first:
                control.rebuild_matrix[0] = 1
                control.asks_for_compression[0] = 1
            if now == scalar(0.0) or (not first and now > scalar(0.5) * before and now <= rounding):
                # what no longer falls, and is less than positions can tell, is rounding
                control.iterate[0] = 0
            control.residual_norm[0] = now
            before = now
        elif control.last_norm[0] <= control.newton_tolerance[0] * control.change[0]:
            # the step was small enough before it was taken: rounding
            control.iterate[0] = 0
        else:
            control.new_direction[0] = 0
            control.rebuild_matrix[0] = 1
            control.step_length[0] = control.step_length[0] * scalar(0.5)
            stalled = stalled or control.step_length[0] < scalar(wp.static(SHORTEST_STEP_LENGTH))
        if status[0] != 0:
            control.iterate[0] = 0
        elif not wp.isfinite(before):
            control.iterate[0] = 0
            status[0] = wp.static(NOT_FINITE)
            status[1] = not_finite(nodes, is_free, rhs, inverse_x)
        elif stalled and control.iterate[0] != 0:
            control.iterate[0] = 0
            # what rounding leaves cannot be taken away; nor is there a need to where the last step was small enough
            small = not first and control.last_norm[0] <= control.newton_tolerance[0] * control.change[0]
            if not (small or before <= rounding * scalar(wp.static(ROUNDING_MARGIN))):
                status[0] = wp.static(STALLED)
                status[1] = -1

    return SimpleNamespace(
        start_rigid=start_rigid,
        check_convergence=check_convergence,
        control_newton=control_newton,
    )


@functools.cache
def define_turning(variant: Variant) -> SimpleNamespace:
    """Define what looks at how far yarns turn."""
    scalar, vec3 = variant.scalar, variant.vec3
    own = general.functions(variant).own

    @wp.kernel(module=variant.module("stage"), enable_backward=False)
    def ask_for_matrix(
        segments: wp.array(dtype=wp.vec4i),
        step_size: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        rebuild_matrix: wp.array(dtype=int),
    ):
        """Asks for a new matrix where a yarn turns in the step."""
        a, b, _sa, _sb, _yarn, direction = ends(segments, index(wp.tid()))
        moved = wp.length(solution[b] - solution[a]) * step_size[0]
        if moved > scalar(wp.static(REBUILDING_TURN)) * spacing[own(2 * a + direction)]:
            rebuild_matrix[0] = 1

    return SimpleNamespace(ask_for_matrix=ask_for_matrix)
