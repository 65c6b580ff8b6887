"""A watch over energy: what a step leaves may not be more than what there was and the work that was done since.

    T + V_stretch + V_pins + V_gravity  ≤  E + W + g × what there is of it beside gravity

E is the whole energy at the last audit, all terms' energies at the beginning of a step, which is made every ``EVERY``
steps: between audits only the cheap terms are added up, and the others count as 0, so that no energy is taken for a
gain that one of them releases. They are added up too where yarns give or take much energy in a step, and for a while
after; then the end of a step is as good as an audit, and E is what it leaves. W is the work of wind, applied forces and
moving pins since. The same must hold from the run's start on. A method of stages has of that work what its stages say:
where air or a spring takes a light cloth along within a step, the power at the step's ends says nothing of it.

g is ``GAIN``: what gains more is made again, damped, in parts, or ends the run, for it would be wrong without saying
so, or blow up. It is ``BLOW_UP`` of methods that have no stages, and of runs that must have a gradient, whose loss
jumps where a step is made otherwise.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.status import GAINED
from ..core.variant import Variant

EVERY = 16
"""Steps between audits: at 16 an audit takes 1 % of a step of the paper's cloth."""
GAIN = 0.01
"""Part of the energy that a step may gain: shear's dependence on the contact force has no energy of its own."""
BLOW_UP = 0.75
"""The same of runs that must have a gradient, of steps that are damped already, and of eq. 2 and ROS2, which know
yarns' stretching at the beginning of a step alone: of 0.75 there may be four times as much as there was."""
SUDDEN = 0.1
"""Part of the energy that yarns give or take in a step that is looked at closely."""
ALERT = 16
"""Steps after that, or after a gain, that are looked at closely too."""
FORGET = 256.0
"""Steps in which the most energy of late is forgotten."""
STILL = 1.0e-6
"""Speed of the whole cloth whose energy may always be gained [m/s]: rounding."""


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3
    module = variant.module("ledger")

    @wp.func
    def allowed_gain(most: scalar, still: scalar, height: scalar) -> scalar:
        """Compute the energy that any step may gain, of the most beside gravity, and of rounding."""
        return scalar(GAIN) * most + still + scalar(1.0e-9) * wp.abs(height)

    @wp.kernel(module=module, enable_backward=False)
    def audit(
        energy: wp.array(dtype=scalar),
        height_energy: wp.array(dtype=scalar),
        # E + W since the last audit, and since the start; energy beside gravity at the last audit; the last step's
        # power, its yarns' energy, and energy beside gravity; the most of that of late
        elastic_energy: wp.array(dtype=scalar),
        still_energy: wp.array(dtype=scalar),
        bounds: wp.array(dtype=scalar),
        alert: wp.array(dtype=int),
        steps_to_audit: wp.array(dtype=int),
        audit_due: wp.array(dtype=int),
    ):
        """Takes all of the energy at the beginning of a step for E; where it was gained unseen, as other terms hold
        more than was gained, the steps to come are looked at closely."""
        total = energy[0] + elastic_energy[0] + height_energy[0]
        # a run that has not made a step has no power yet
        if bounds[3] < scalar(-1.0e30):
            bounds[0] = total
            bounds[1] = total
            bounds[4] = elastic_energy[0]
            bounds[6] = energy[0] + elastic_energy[0]
        else:
            most = wp.max(energy[0] + elastic_energy[0], bounds[6])
            if total > wp.min(bounds[0], bounds[1]) + allowed_gain(most, still_energy[0], height_energy[0]):
                alert[0] = wp.static(ALERT)
            bounds[0] = wp.min(bounds[0], total)
        bounds[2] = energy[0] + elastic_energy[0]
        steps_to_audit[0] = wp.static(EVERY)
        audit_due[0] = 0

    @wp.kernel(module=module, enable_backward=False)
    def add_power(
        force: wp.array(dtype=vec3),
        outer_force: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        power: wp.array(dtype=scalar),
    ):
        """Add up the power of outer forces, and what it would be with those at the beginning of the step."""
        i = index(wp.tid())
        wp.atomic_add(power, 0, wp.dot(force[i], velocity[i]))
        wp.atomic_add(power, 1, wp.dot(outer_force[i], velocity[i]))

    @wp.kernel(module=module, enable_backward=False)
    def keep_outer_force(status: wp.array(dtype=int), force: wp.array(dtype=vec3), outer_force: wp.array(dtype=vec3)):
        """Keep the forces at the beginning of the next step, if this one is good."""
        i = index(wp.tid())
        if status[0] == 0:
            outer_force[i] = force[i]

    @wp.kernel(module=module, enable_backward=False)
    def add_pin_power(
        pin_node: wp.array(dtype=int),
        pin_stiffness: wp.array(dtype=scalar),
        pin_target: wp.array(dtype=vec3),
        pin_motion: wp.array(dtype=vec3),
        step_duration: scalar,
        position: wp.array(dtype=vec3),
        power: wp.array(dtype=scalar),
    ):
        """Add up the power of moving pins: the force of their springs times their velocity."""
        e = index(wp.tid())
        pull = (pin_target[e] - position[index(pin_node[e])]) * pin_stiffness[0]
        of_pin = wp.dot(pull, pin_motion[e]) / step_duration
        wp.atomic_add(power, 0, of_pin)
        wp.atomic_add(power, 1, of_pin)

    @wp.kernel(module=module, enable_backward=False)
    def add_work(
        stage: int,
        stage_shares: wp.array(dtype=scalar),
        step_size: wp.array(dtype=scalar),
        power: wp.array(dtype=scalar),
        stage_work: wp.array(dtype=scalar),
    ):
        """Add up the work of a stage's power, which makes its share of the step."""
        stage_work[0] += stage_shares[stage] * step_size[0] * power[0]

    @wp.kernel(module=module, enable_backward=False)
    def suspect(
        energy: wp.array(dtype=scalar),
        elastic_energy: wp.array(dtype=scalar),
        bounds: wp.array(dtype=scalar),
        alert: wp.array(dtype=int),
        looks_closely: wp.array(dtype=int),
    ):
        """Choose whether to add up the other terms too."""
        exchanged = wp.abs(elastic_energy[0] - bounds[4])
        if exchanged > scalar(SUDDEN) * wp.max(energy[0] + elastic_energy[0], bounds[2]):
            alert[0] = wp.static(ALERT)
        looks_closely[0] = alert[0]

    @wp.kernel(module=module, enable_backward=False)
    def close_step(
        energy: wp.array(dtype=scalar),
        elastic_energy: wp.array(dtype=scalar),
        height_energy: wp.array(dtype=scalar),
        power: wp.array(dtype=scalar),
        gain: wp.array(dtype=scalar),
        by_stages: int,
        stage_work: wp.array(dtype=scalar),
        still_energy: wp.array(dtype=scalar),
        step_size: wp.array(dtype=scalar),
        bounds: wp.array(dtype=scalar),
        damps: wp.array(dtype=int),
        alert: wp.array(dtype=int),
        looks_closely: wp.array(dtype=int),
        steps_to_audit: wp.array(dtype=int),
        audit_due: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """Compares the end of a step with the bounds, which move on if the step is good."""
        if status[0] == 0:
            # methods take the force or the velocity of either end: the largest that the power may have been
            work = wp.max(wp.max(power[0], power[1]), bounds[3]) * step_size[0]
            if by_stages != 0:
                # what the method itself makes of it; its own error where wind takes a light cloth along is no gain
                work = wp.max(work, stage_work[0])
            inner = energy[0] + elastic_energy[0]
            total = inner + height_energy[0]
            # what there was at the last audit, or at the last step
            before = wp.max(bounds[2], bounds[5])
            # the most of late: a cloth that swings has none of it at its highest
            most = wp.max(wp.max(inner, before), bounds[6])
            room = allowed_gain(most, still_energy[0], height_energy[0])
            if gain[0] > scalar(GAIN) or by_stages == 0:
                room += scalar(BLOW_UP) * wp.max(inner, before)
            bound = wp.min(bounds[0], bounds[1])
            if damps[0] != 0:
                # there is no surer method: what there was at the start counts, and a part that cannot be halved again
                # may only not blow up
                bound = bounds[1]
                if damps[0] > 1:
                    room += scalar(BLOW_UP) * wp.max(inner, before)
            if not (total <= bound + work + room):
                status[0] = wp.static(GAINED)
                status[1] = -1
                alert[0] = wp.static(ALERT)
            else:
                # what was dissipated is not to be gained again
                dissipated = bound + work - total > scalar(0.5) * most and steps_to_audit[0] <= wp.static(EVERY - 4)
                bounds[6] = wp.where(dissipated, inner, most * scalar(wp.static(1.0 - 1.0 / FORGET)))
                bounds[0] += work
                bounds[1] += work
                if looks_closely[0] != 0:
                    # all terms are added up, as at an audit
                    bounds[0] = wp.min(bounds[0], total)
                bounds[3] = power[0]
                bounds[4] = elastic_energy[0]
                bounds[5] = inner
                alert[0] = wp.max(alert[0] - 1, 0)
                steps_to_audit[0] = steps_to_audit[0] - 1
                audit_due[0] = wp.where(steps_to_audit[0] <= 0 or dissipated, 1, 0)

    return SimpleNamespace(
        audit=audit,
        add_power=add_power,
        keep_outer_force=keep_outer_force,
        add_pin_power=add_pin_power,
        add_work=add_work,
        suspect=suspect,
        close_step=close_step,
    )
