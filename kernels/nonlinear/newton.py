"""An implicit stage: the velocity w at which momentum is conserved at the state that w itself leads to.

    r(w) = η F(q, w) + M(q) (v₀ − w) = 0,   q = q₀ + η w

Every implicit method here is made of such stages, and of q₀ + t w and v₀ + k (w − v₀) that carry one to the next or to
the end of a step (``warp_yarn/integrators``). Newton's iteration takes A, the symmetric positive definite part of
−∂r/∂w, for its matrix: M + η D + η² H. The adjoint of a stage that has converged is (−∂r/∂w)ᵀ λ = w̄, with the exact
derivative (``stage_adjoint.py``).
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import coordinates, index
from ..core.memory import functions as access
from ..core.status import NOT_FINITE, ORDER_LOST, STALLED
from ..core.variant import Variant

MOST_TRIES = 200
"""Evaluations in a stage. Newton's iteration takes 2 or 3 in ordinary motion; A leaves out what is not symmetric, so
that violent sliding brings them to dozens."""
SHORTEST_STEP = 2.0**-24
"""Of the line search: where crossings nearly touch, or l and Δs shrink together, which costs next to no energy, it must
be short indeed."""
NEAREST = 0.1
"""Part of a Δs that a step of the iteration leaves of it at least."""
EXTRAPOLATED = 0.5
"""Part of a Δs that must be left where a first stage is extrapolated to the second one's base, else the step is split:
where crossings fly at each other, the second stage would begin inside the barrier, and gain several times the energy
of the start."""
TURNED = 0.9
"""Part of the slope that a step of the iteration may turn to with the other sign (``integrators/stage.py``)."""
SLOW = 0.3
"""Part of a residual that a step leaves, above which the next evaluation brings a new matrix along: at 0.1, more
matrices cost more than the iterations that they saved (17 × 17, steps of 2 ms)."""
CAUTION = 4.0
"""What a step of the iteration leaves is taken to be so many times what the contraction before it says."""
TRUSTED = 1e-3
"""The least contraction that is believed: a cloth that moves as one is solved at once, and what comes next is not."""
TURNING = 0.03
"""Angle by which a yarn turns in a step, above which its second stage has a matrix of its own: below 0.025, one
iteration did with that of the first stage, above 0.045, two to seven, and one or two with its own (17 × 17)."""
ROUNDING = 10.0
"""Times the rounding of positions that a residual may end with where no step takes more of it away."""
COARSENESS = {wp.float64: 1e-15, wp.float32: 5e-7}
"""A few units in the last place."""


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    at, put = access(variant).at, access(variant).put
    module = variant.module("stage")

    @wp.kernel(module=module, enable_backward=False)
    def enter_stage(
        stage_size: wp.array(dtype=scalar),
        base_position: wp.array(dtype=vec3),
        base_euler: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        increment: wp.array(dtype=vec3),
        euler_increment: wp.array(dtype=scalar),
    ):
        """q = q₀ + η w, q̇ = w, and v₀ − w, whose momentum the residual has."""
        i = index(wp.tid())
        w = solution[i]
        position[i] = base_position[i] + w * stage_size[0]
        velocity[i] = w
        increment[i] = base_velocity[i] - w
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                rate = euler_solution[s]
                euler[s] = base_euler[s] + rate * stage_size[0]
                euler_velocity[s] = rate
                euler_increment[s] = base_euler_velocity[s] - rate

    @wp.kernel(module=module, enable_backward=False)
    def look_ahead(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        stage_size: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        base_euler: wp.array(dtype=scalar),
        euler_solution: wp.array(dtype=scalar),
        crosses: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """Whether crossings would pass each other at the velocity that the iteration starts from, and whether the base
        has them much nearer to each other than the first stage left them."""
        e = index(wp.tid())
        sa, sb = coordinates(segment_nodes, segment_yarn, yarn_direction, e)
        rest = base_euler[sb] - base_euler[sa]
        if rest + (euler_solution[sb] - euler_solution[sa]) * stage_size[0] <= scalar(0.0):
            crosses[0] = 1
        if rest < scalar(EXTRAPOLATED) * (euler[sb] - euler[sa]):
            if wp.atomic_cas(status, 0, 0, wp.static(ORDER_LOST)) == 0:
                status[1] = segment_nodes[e][0]

    @wp.kernel(module=module, enable_backward=False)
    def correct(
        step_length: wp.array(dtype=scalar),
        solution_before: wp.array(dtype=vec3),
        euler_solution_before: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
    ):
        """w + α δ."""
        i = index(wp.tid())
        solution[i] = solution_before[i] + direction[i] * step_length[0]
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                euler_solution[s] = euler_solution_before[s] + euler_direction[s] * step_length[0]

    @wp.kernel(module=module, enable_backward=False)
    def lump_mass(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        density: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        node_mass: wp.array(dtype=scalar),
    ):
        """Half of every segment's mass to each of its nodes."""
        e = index(wp.tid())
        sa, sb = coordinates(segment_nodes, segment_yarn, yarn_direction, e)
        m = scalar(0.5) * density[index(segment_yarn[e])] * (euler[sb] - euler[sa])
        wp.atomic_add(node_mass, index(segment_nodes[e][0]), m)
        wp.atomic_add(node_mass, index(segment_nodes[e][1]), m)

    @wp.kernel(module=module, enable_backward=False)
    def start_rigid(
        nodes: int,
        node_mass: wp.array(dtype=scalar),
        touching: wp.array(dtype=int),
        rhs: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
    ):
        """δ of a free cloth that moves as one: the solver need not find how it falls, to its tolerance."""
        if touching[0] != 0:
            # what it touches does not let it
            return
        momentum = vec3()
        mass = scalar(0.0)
        for i in range(nodes):
            momentum += at(rhs, i)
            mass += at(node_mass, i)
        for i in range(nodes):
            put(direction, i, momentum / mass)

    @wp.kernel(module=module, enable_backward=False)
    def search(
        nodes: int,
        node_mass: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
        slope: wp.array(dtype=scalar),
        kinetic: wp.array(dtype=scalar),
        step_length: wp.array(dtype=scalar),
    ):
        """Begins a line search along δ: a full step first, r·δ, how fast r falls along δ, and of the change of velocity
        g = w + δ − v₀ that it leads to, g·M g."""
        total = scalar(0.0)
        square = scalar(0.0)
        for i in range(nodes):
            d = at(direction, i)
            total += wp.dot(at(rhs, i), d)
            gain = vec3()
            if is_free[i] != 0:
                gain = at(solution, i) + d - at(base_velocity, i)
            along = scalar(0.0)
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    d_s = at(euler_direction, s)
                    total += at(euler_rhs, s) * d_s
                    gain_s = at(euler_solution, s) + d_s - at(base_euler_velocity, s)
                    along += scalar(0.5) * gain_s * gain_s
            square += at(node_mass, i) * (wp.dot(gain, gain) + along)
        slope[0] = total
        kinetic[0] = square
        step_length[0] = scalar(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def decide(
        stage: int,
        newton_tolerance: wp.array(dtype=scalar),
        slope: wp.array(dtype=scalar),
        kinetic: wp.array(dtype=scalar),
        step_length: wp.array(dtype=scalar),
        # of the step of the iteration before; of the time step
        last_norm: wp.array(dtype=scalar),
        contraction: wp.array(dtype=scalar),
        change: wp.array(dtype=scalar),
        first_change: wp.array(dtype=scalar),
        steps: wp.array(dtype=int),
        finishes: wp.array(dtype=int),
        newton_iterations: wp.array(dtype=int),
        residual: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Whether the step along δ is the last one: what it leaves is small beside how much velocities change.

        ‖δ‖ is in the norm of A, √(δ·A δ) = √(r·δ), which is more than that of M, and the change in that of M: kinetic
        energy. What it leaves is taken from the contraction.
        """
        norm = wp.sqrt(wp.max(slope[0], scalar(0.0)))
        left = scalar(CAUTION)
        if steps[0] > 0:
            contraction[0] = wp.max(norm / last_norm[0], scalar(TRUSTED))
            left *= contraction[0]
        elif stage == 0:
            # not known of a time step's first
            left = scalar(1.0)
        else:
            # that of the stage before, whose matrix this one begins with
            left *= contraction[0] * scalar(CAUTION)
        # not of the first δ, of which the line search may take little
        change[0] = wp.sqrt(kinetic[0])
        if stage == 0:
            first_change[0] = change[0]
        else:
            change[0] = wp.max(change[0], first_change[0])
        steps[0] = steps[0] + 1
        last_norm[0] = norm
        newton_iterations[0] = newton_iterations[0] + 1
        if status[0] == 0:
            residual[0] = norm / wp.max(change[0], scalar(1.0e-30))
        finishes[0] = 0
        small = left < scalar(1.0) and left * norm <= newton_tolerance[0] * change[0]
        if norm == scalar(0.0) or (step_length[0] == scalar(1.0) and small):
            finishes[0] = 1
        if -slope[0] > newton_tolerance[0] * change[0] * newton_tolerance[0] * change[0] and status[0] == 0:
            # a direction along which r does not fall: the linear solve has no digit right
            status[0] = wp.static(STALLED)
            status[1] = -1

    @wp.kernel(module=module, enable_backward=False)
    def judge(
        nodes: int,
        is_free: wp.array(dtype=int),
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        shortest: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        newton_tolerance: wp.array(dtype=scalar),
        last_norm: wp.array(dtype=scalar),
        change: wp.array(dtype=scalar),
        # line search, in and out
        slope: wp.array(dtype=scalar),
        step_length: wp.array(dtype=scalar),
        size: wp.array(dtype=scalar),
        tries: wp.array(dtype=int),
        # what to do next, and report, out
        continues: wp.array(dtype=int),
        solves: wp.array(dtype=int),
        refreshes: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """Whether Newton's iteration goes on from w, takes back half of the way to w, or cannot go further.

        ‖r‖ is in the norm of A's inverse diagonal, the mean of each node's, so that it is the same in every frame.
        """
        one = scalar(1.0)
        turned = scalar(0.0)
        of_rhs = scalar(0.0)
        of_rounding = scalar(0.0)
        for i in range(nodes):
            inverse = at(inverse_x, i)
            r = at(rhs, i)
            if inverse[0] > scalar(0.0) and inverse[1] > scalar(0.0) and inverse[2] > scalar(0.0):
                x = at(position, i)
                stiffness = (one / inverse[0] + one / inverse[1] + one / inverse[2]) * scalar(wp.static(1.0 / 3.0))
                of_rhs += wp.dot(r, r) / stiffness
                of_rounding += wp.dot(x, x) * stiffness
                turned += wp.dot(r, at(direction, i))
            elif is_free[i] != 0:
                # a matrix without bounds: nothing here means anything
                of_rhs += scalar(wp.static(float("inf")))
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    inverse_along = at(inverse_s, s)
                    if inverse_along > scalar(0.0):
                        r_s = at(euler_rhs, s)
                        of_rhs += inverse_along * r_s * r_s
                        of_rounding += at(euler, s) * at(euler, s) / inverse_along
                        turned += r_s * at(euler_direction, s)
        now = wp.sqrt(of_rhs)
        # velocities that positions are too coarse to tell from 0
        rounding = wp.sqrt(of_rounding) * scalar(wp.static(COARSENESS[scalar])) / stage_size[0]
        before = size[0]
        first = tries[0] == 0
        tries[0] = tries[0] + 1
        continues[0] = 1
        solves[0] = 1
        refreshes[0] = 0
        stalled = tries[0] > wp.static(MOST_TRIES)
        ordered = bool(True)
        if wp.static(sliding):
            ordered = shortest[0] > scalar(0.0)
            shortest[0] = scalar(wp.static(1.0e30))
        if first or (ordered and (now < before or turned > scalar(-TURNED) * slope[0])):
            if not first and now > scalar(SLOW) * before:
                # a step that hardly helps: the matrix is of another state
                refreshes[0] = 1
            if now == scalar(0.0) or (not first and now > scalar(0.5) * before and now <= rounding):
                # what no longer falls, and is less than positions can tell, is rounding
                continues[0] = 0
            size[0] = now
            before = now
        elif last_norm[0] <= newton_tolerance[0] * change[0]:
            # the step was small enough before it was taken: rounding
            continues[0] = 0
        else:
            solves[0] = 0
            refreshes[0] = 1
            step_length[0] = step_length[0] * scalar(0.5)
            stalled = stalled or step_length[0] < scalar(wp.static(SHORTEST_STEP))
        if status[0] != 0:
            continues[0] = 0
        elif not wp.isfinite(before):
            continues[0] = 0
            status[0] = wp.static(NOT_FINITE)
            status[1] = -1
            for i in range(nodes):
                if is_free[i] != 0 and not (wp.isfinite(rhs[i]) and wp.min(inverse_x[i]) > scalar(0.0)):
                    status[1] = i
        elif stalled and continues[0] != 0:
            continues[0] = 0
            # what rounding leaves cannot be taken away; nor is there a need to where the last step was small enough
            small = not first and last_norm[0] <= newton_tolerance[0] * change[0]
            if not (small or before <= rounding * scalar(wp.static(ROUNDING))):
                status[0] = wp.static(STALLED)
                status[1] = -1

    @wp.kernel(module=module, enable_backward=False)
    def shortest_segment(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        euler: wp.array(dtype=scalar),
        shortest: wp.array(dtype=scalar),
    ):
        e = index(wp.tid())
        sa, sb = coordinates(segment_nodes, segment_yarn, yarn_direction, e)
        wp.atomic_min(shortest, 0, euler[sb] - euler[sa])

    @wp.kernel(module=module, enable_backward=False)
    def keep_order(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        stage_size: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        euler_direction: wp.array(dtype=scalar),
        step_length: wp.array(dtype=scalar),
    ):
        """Shortens the step along δ so far that it leaves something of every Δs."""
        e = index(wp.tid())
        sa, sb = coordinates(segment_nodes, segment_yarn, yarn_direction, e)
        rest = euler[sb] - euler[sa]
        loss = (euler_direction[sa] - euler_direction[sb]) * stage_size[0]
        allowed = rest * scalar(wp.static(1.0 - NEAREST))
        if loss > allowed and rest > scalar(0.0):
            wp.atomic_min(step_length, 0, allowed / loss)

    @wp.kernel(module=module, enable_backward=False)
    def ask_for_matrix(
        segment_nodes: wp.array(dtype=wp.vec2i),
        step_size: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        refreshes: wp.array(dtype=int),
    ):
        """Asks for a new matrix where a yarn turns in the step."""
        e = index(wp.tid())
        a = index(segment_nodes[e][0])
        b = index(segment_nodes[e][1])
        moved = wp.length(solution[b] - solution[a]) * step_size[0]
        if moved > scalar(wp.static(TURNING)) * spacing[0]:
            refreshes[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def next_base(
        carried_time: wp.array(dtype=scalar),
        carried_rate: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        start: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        base_euler: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
    ):
        """q₀ + t w and v₀ + k (w − v₀): from a stage's base to the next stage's, which starts from the same gain of
        velocity if asked for one. Sliding rates start from those of the stage before: they have next to no inertia."""
        i = index(wp.tid())
        w = solution[i]
        gain = w - base_velocity[i]
        v0 = base_velocity[i] + gain * carried_rate[0]
        base_position[i] = base_position[i] + w * carried_time[0]
        base_velocity[i] = v0
        if start and is_free[i] != 0:
            start[i] = v0 + gain
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                rate = euler_solution[s]
                gain_s = rate - base_euler_velocity[s]
                base_euler[s] = base_euler[s] + rate * carried_time[0]
                base_euler_velocity[s] += gain_s * carried_rate[0]

    @wp.kernel(module=module, enable_backward=False)
    def estimate_error(
        nodes: int,
        step_size: wp.array(dtype=scalar),
        missing: wp.array(dtype=scalar),
        predicted: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        step_error: wp.array(dtype=scalar),
    ):
        """Of the node that is farthest off: h · missing · |w₂ − what the first stage's acceleration led to|."""
        most = scalar(0.0)
        for i in range(nodes):
            most = wp.max(most, wp.length_sq(at(solution, i) - at(predicted, i)))
        step_error[0] = wp.sqrt(most) * missing[0] * step_size[0]

    return SimpleNamespace(
        enter_stage=enter_stage,
        look_ahead=look_ahead,
        correct=correct,
        lump_mass=lump_mass,
        start_rigid=start_rigid,
        search=search,
        decide=decide,
        judge=judge,
        shortest_segment=shortest_segment,
        keep_order=keep_order,
        ask_for_matrix=ask_for_matrix,
        next_base=next_base,
        estimate_error=estimate_error,
    )
