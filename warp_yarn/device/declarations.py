"""Every array of a scene on the device: what each is of, how many, its type and unit, when it is there, and what it is.

Arrays are made from these declarations (``arrays.py``), and no other name can be set or launched with. A test holds
every argument of every kernel to them (``tests/kernels/test_declarations.py``). A group is what is made together.
One **world** is one independent simulation of a batch, today the only one: what steers it is an array over worlds.
The field ``when`` names a condition of the scene (``fields.conditions``). Where it does not hold the name is None.
"""

import dataclasses

from ..description.strips import SOURCES
from ..kernels.linear.block_tridiagonal import factor_size
from .contact_declarations import CONTACT, CONTACT_INPUTS, CRIMP
from .explicit_declarations import EXPLICIT_ADJOINT, EXPLICIT_STAGE, SLOPES
from .fields import Field, Group

TOPOLOGY: Group = {
    "nodes": Field("count", 1, "int", "", "always", "nodes of the cloth"),
    "columns": Field("count", 1, "int", "", "always", "nodes of a warp yarn, which threads divide among them"),
    "stencil": Field("count", 1, "int", "", "always", "upper neighbours of a node in the matrix: 2, 4, 6 or 8"),
    "segments": Field("segment", 1, "vec4i", "", "always", "nodes a < b, yarn, direction (0 warp, 1 weft)"),
    "yarn_direction": Field("yarn", 1, "int", "", "always", "0 of a warp yarn, 1 of a weft yarn"),
    "bend_nodes": Field("bend", 1, "vec3i", "", "always", "consecutive nodes a < c < b of a yarn"),
    "bend_yarn": Field("bend", 1, "int", "", "always", "its yarn"),
    "crossing_node": Field("crossing", 1, "int", "", "always", "its node"),
    "crossing_neighbours": Field("crossing", 1, "vec4i", "", "always", "nodes left, right, up, down"),
    "corner_jams": Field("crossing", 1, "vec4i", "", "shear", "1 where a corner can jam: lu, ld, ru, rd"),
    "corner_blocks": Field("crossing", 1, "vec4i", "", "shear", "matrix blocks of the same corners"),
    "triangle_nodes": Field("triangle", 1, "vec3i", "", "wind", "its nodes"),
    "triangle_blocks": Field("triangle", 1, "vec3i", "", "wind", "matrix blocks of its edges"),
    "seam_nodes": Field("seam", 2, "int", "", "seams", "its two nodes"),
    "seam_block": Field("seam", 1, "int", "", "seams", "their matrix block"),
    "is_crossing": Field("node", 1, "int", "", "always", "1 at a crossing, 0 on the border"),
    "is_free": Field("node", 1, "int", "", "always", "0 where a hard pin holds a node, else 1"),
    "flipped": Field("node", 1, "int", "", "always", "the draft: which yarn is on top"),
    "node_yarns": Field("node", 2, "int", "", "general", "its warp yarn and its weft yarn, or -1"),
    "neighbour": Field("block", 1, "int", "", "always", "upper neighbours of a node in the matrix, or -1"),
}  # of description/topology.py and seams.py

PARAMETERS: Group = {
    "density": Field("yarn", 1, "scalar", "kg/m", "always", "ρ"),
    "stretch": Field("yarn", 1, "scalar", "Pa", "always", "stretch modulus Y"),
    "bend": Field("yarn", 1, "scalar", "Pa m²", "always", "bending modulus B"),
    "spacing": Field("gap", 1, "scalar", "m", "always", "L; and half the widths of a node's yarns"),
    "radius": Field("half", 1, "scalar", "m", "always", "R, half the width and half the thickness; and 1 + crimp"),
    "lengthening": Field("yarn", 1, "scalar", "", "general", "1 + crimp: length over the distance that it covers"),
    "shear": Field("cloth crossing", 1, "scalar", "Pa", "always", "shear modulus S"),
    "friction": Field("cloth crossing", 1, "scalar", "", "always", "μ"),
    "friction_stiffness": Field("cloth crossing", 1, "scalar", "N/m", "always", "k_f"),
    "friction_damping": Field("cloth crossing", 1, "scalar", "N s/m", "always", "d_f"),
    "friction_sharpness": Field("cloth", 1, "scalar", "", "always", "p of the law's tanh"),
    "parallel_stiffness": Field("cloth", 1, "scalar", "N/m", "always", "k_c"),
    "lock_angle": Field("corner", 1, "scalar", "rad", "always", "φ_l = 2 arcsin(R/L)"),
    "published_scaling": Field("count", 1, "int", "", "always", "1: friction with arguments in SI units, as published"),
}
"""What a scene says of its yarns and its cloth. A plain cloth has one gap, half, corner and cloth crossing; a general
one (``kernels/core/general.py``) four gaps of each node, three halves of each yarn, four corners of each crossing, and
as many cloth crossings as nodes."""

INPUTS: Group = {
    "gravity": Field("world", 1, "vec3", "m/s²", "has gravity", "g, in this step"),
    "gravity_path": Field("gravity step", 1, "vec3", "m/s²", "gravity changes", "in every step"),
    "wind_velocity": Field("world", 1, "vec3", "m/s", "has wind", "of the air, in this step"),
    "wind_velocity_path": Field("wind step", 1, "vec3", "m/s", "wind changes", "in every step"),
    "wind_density": Field("world", 1, "scalar", "kg/m³", "has wind", "ρ_w"),
    "wind_drag": Field("world", 1, "scalar", "kg/(m² s)", "has wind", "c_d"),
    "seam_stiffness": Field("world", 1, "scalar", "N/m", "seams", "k of every pair of nodes that is sewn together"),
    "pin_node": Field("pin", 1, "int", "", "has pins", "its node"),
    "pin_target": Field("pin", 1, "vec3", "m", "has pins", "where a pin is at the time of a stage"),
    "pin_target_path": Field("pin step", 1, "vec3", "m", "pins move", "where it is to be after every step"),
    "pin_start": Field("pin", 1, "vec3", "m", "pins move", "where it is before the first step"),
    "pin_motion": Field("pin", 1, "vec3", "m", "pins move", "how far it goes in a step"),
    "pin_stiffness": Field("world", 1, "scalar", "N/m", "spring pins", "k_h"),
    "applied_node": Field("applied", 1, "int", "", "has forces", "its node"),
    "applied_force": Field("applied", 1, "vec3", "N", "has forces", "in this step"),
    "applied_force_path": Field("applied step", 1, "vec3", "N", "forces change", "in every step"),
}
"""What acts on the cloth. What a scene does not have is not in the arrays at all."""

STATE: Group = {
    "position": Field("node", 1, "vec3", "m", "always", "x, counted from ``Arrays.origin``"),
    "euler": Field("node", 2, "scalar", "m", "always", "(u, v)"),
    "velocity": Field("node", 1, "vec3", "m/s", "always", "ẋ"),
    "euler_velocity": Field("node", 2, "scalar", "m/s", "sliding", "(u̇, v̇)"),
    "anchor": Field("node", 2, "scalar", "m", "friction", "(ū, v̄), where friction's springs are anchored"),
}
"""What a step leaves to the next."""

STEP: Group = {
    "evaluations": Field("world", 1, "int", "", "always", "of the residual in this stage"),
    "status": Field("world", 3, "int", "", "always", "what went wrong (core/status.py), its node or -1, its step"),
    "counters": Field("world", 2, "int", "", "always", "the present frame of the chunk, and the present step"),
    "step_size": Field("world", 1, "scalar", "s", "always", "h"),
    "remaining": Field("world", 1, "scalar", "s", "always", "time in which hard pins reach their targets"),
    "stage_times": Field("world", 6, "scalar", "steps", "always", "of three stages, the step's end and start, a slope"),
    "coefficients": Field("world", 1, "vec3", "1, s, s²", "always", "what M, D and H are multiplied by in the matrix"),
}
"""What steers a step."""

ASSEMBLY: Group = {
    "normal": Field("node", 1, "vec3", "", "contact", "from warp to weft, 0 on the border"),
    "contact_load": Field("node", 1, "scalar", "N", "contact", "what presses warp and weft together, where above 0"),
    "gust": Field("node", 1, "vec3", "m/s", "gusts", "velocity of the air at a node, beside wind_velocity"),
    "force": Field("node", 1, "vec3", "N", "always", "F of the positions"),
    "euler_force": Field("node", 2, "scalar", "N", "sliding", "F of (u, v), but for friction"),
    "friction_force_out": Field("node", 2, "scalar", "N", "friction", "friction's F of (u, v)"),
    "momentum": Field("node", 1, "vec3", "N s", "always", "M q̇ + h D q̇ of the positions"),
    "euler_momentum": Field("node", 2, "scalar", "N s", "sliding", "the same of (u, v)"),
    "diagonal_xx": Field("node", 1, "mat33", "kg", "always", "blocks of the matrix, as linear/block_matrix.py tells"),
    "diagonal_xs": Field("node", 2, "vec3", "kg", "sliding", "row x, column s of a node"),
    "diagonal_ss": Field("node", 2, "scalar", "kg", "sliding", "row s, column s"),
    "upper_xx": Field("block", 1, "mat33", "kg", "always", "row x of a node, column x of an upper neighbour"),
    "upper_xs": Field("node", 4, "vec3", "kg", "sliding", "row x, column s of the four along its yarns"),
    "upper_sx": Field("node", 4, "vec3", "kg", "sliding", "row s, column x"),
    "upper_ss": Field("node", 4, "scalar", "kg", "sliding", "row s, column s"),
    "rhs": Field("node", 1, "vec3", "N s", "always", "right-hand side, or residual of a stage"),
    "euler_rhs": Field("node", 2, "scalar", "N s", "sliding", "the same of (u, v)"),
    "solution": Field("node", 1, "vec3", "m/s", "always", "w, the velocities that are solved for"),
    "euler_solution": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
}
"""What the terms write, and the linear system that is made of it."""

LINEAR_WORKSPACE: Group = {
    "inverse_x": Field("node", 1, "vec3", "1/kg", "always", "inverse diagonal of the matrix, 0 where held"),
    "inverse_s": Field("node", 2, "scalar", "1/kg", "sliding", "the same of (u, v), 0 on the border"),
    "inverse_pivot": Field("node", 1, "sym33", "1/kg", "always", "E⁻¹ of the incomplete factorization, 0 where held"),
    "r_x": Field("node", 1, "vec3", "N s", "always", "residual; elsewhere space to work in, as all that follow"),
    "r_s": Field("node", 2, "scalar", "N s", "sliding", "the same of (u, v)"),
    "p_x": Field("node", 1, "vec3", "m/s", "always", "direction; in the residual's sense with the incomplete one"),
    "p_s": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "q_x": Field("node", 1, "vec3", "N s", "always", "A p"),
    "q_s": Field("node", 2, "scalar", "N s", "sliding", "the same of (u, v)"),
    "t_x": Field("node", 1, "vec3", "m/s", "always", "preconditioned residual or direction"),
    "t_s": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "sums": Field("thread", 5, "scalar", "J", "always", "parts of scalar products"),
    "signals": Field("signal", 1, "int", "", "always", "where threads wait for each other (linear/threads.py)"),
    "tolerance": Field("world", 1, "scalar", "", "always", "of the residual, relative to the start's"),
    "iterations": Field("world", 1, "int", "", "always", "of the last solve"),
    "residual": Field("world", 1, "scalar", "", "always", "where the last solve, or Newton's iteration, ended"),
}
"""What linear solves work with, and their report."""

THREADS_WORKSPACE: Group = {
    "helper_rhs": Field("node", 1, "vec3", "N s", "always", "what helping threads were launched with in its place"),
    "helper_euler_rhs": Field("node", 2, "scalar", "N s", "sliding", "the same of (u, v)"),
    "helper_tolerance": Field("world", 1, "scalar", "", "always", "the same of the tolerance"),
    "helper_solution": Field("node", 1, "vec3", "m/s", "always", "the same of the solution"),
    "helper_euler_solution": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
}
"""Of solves that several threads share."""

LEVELS: Group = {
    "coarse_levels": Field("count", 1, "int", "", "always", "how many levels there are above the cloth"),
    "blocks_per_node": Field("count", 1, "int", "", "always", "matrix blocks of a coarse node"),
    "warp_lines": Field("count", 1, "int", "", "always", "warp yarns of the cloth, the first of its lines"),
    "coarse_warp_lines": Field("count", 1, "int", "", "always", "the same of all coarse levels"),
    "exact": Field("count", 1, "int", "", "always", "nodes of the last level, which is solved exactly"),
    "line_start": Field("line end", 1, "int", "", "always", "where the nodes of a yarn begin in ``line_node``"),
    "line_node": Field("line node", 1, "int", "", "always", "nodes, yarn after yarn"),
    "lower": Field("block", 1, "int", "", "always", "the node whose upper neighbour in this slot a node is, or -1"),
    "level_start": Field("level end", 1, "int", "", "always", "where the nodes of a level begin"),
    "coarse_line_start": Field("coarse line end", 1, "int", "", "always", "as line_start, of coarse levels"),
    "coarse_line_node": Field("coarse line node", 1, "int", "", "always", "as line_node, of coarse levels"),
    "parent": Field("any node", 4, "int", "", "always", "coarse nodes that a node is interpolated from, or -1"),
    "parent_weight": Field("any node", 4, "scalar", "", "always", "by how much"),
    "child_start": Field("coarse node end", 1, "int", "", "always", "where the children of a node begin in ``child``"),
    "child": Field("child", 1, "int", "", "always", "nodes of the level below"),
    "child_weight": Field("child", 1, "scalar", "", "always", "by how much"),
    "block_start": Field("coarse block end", 1, "int", "", "always", "where the parts of a block begin in ``part``"),
    "part": Field("part", 1, "int", "", "always", "blocks of the level below; ~ of what stands there transposed"),
    "part_weight": Field("part", 1, "scalar", "", "always", "by how much"),
    "coarsest_slot": Field("coarsest pair", 1, "int", "", "always", "which block of one node another is, or -1"),
    "coarse_block": Field("coarse block", 1, "mat33", "kg", "always", "RᵀAR of all levels"),
    "line_factor": Field("line factor", 1, "scalar", "", "always", "G and E⁻¹ of all lines of the cloth"),
    "coarse_line_factor": Field("coarse line node", 24, "scalar", "", "always", "the same of coarse levels"),
    "halves": Field("node", 1, "sym33", "1/kg", "always", "½ D⁻¹ of both lines of a node"),
    "coarse_halves": Field("coarse node", 1, "sym33", "1/kg", "always", "the same of coarse levels"),
    "coarsest": Field("coarsest entry", 1, "scalar", "", "always", "Cholesky factor of the last level"),
    "strips": Field("count", 1, "int", "", "always", "strips of two yarns; 0 where lines do"),
    "strip_phase": Field("strip phase", 1, "int", "", "always", "where the strips of a phase begin"),
    "strip_start": Field("strip end", 1, "int", "", "always", "where the places of a strip begin"),
    "strip_node": Field("strip place", 2, "int", "", "always", "both nodes of a place, or -1"),
    "strip_source": Field("strip place", SOURCES, "int", "", "always", "1 + matrix blocks; negative: transposed; or 0"),
    "strip_factor": Field("strip place", factor_size(6), "scalar", "", "always", "G and E⁻¹ of all strips"),
    "strip_work": Field("strip place", 8, "scalar", "", "always", "space to work in"),
    "line_work": Field("line node", 4, "scalar", "", "always", "space to work in, as all that follow"),
    "coarse_line_work": Field("coarse line node", 4, "scalar", "", "always", "the same of coarse levels"),
    "coarse_r": Field("coarse node", 1, "vec3", "N s", "always", "residual"),
    "coarse_z": Field("coarse node", 1, "vec3", "m/s", "always", "preconditioned residual"),
}
"""Of the multilevel preconditioner (``description/levels.py``): one struct, ``arrays["levels"]``."""

STAGES: Group = {
    "stage_size": Field("world", 1, "scalar", "s", "always", "η"),
    "increment": Field("node", 1, "vec3", "m/s", "always", "velocities whose momentum the right-hand side has"),
    "euler_increment": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
}
"""Of methods that have stages."""

FIRST_STAGE: Group = {
    "first_solution": Field("node", 1, "vec3", "m/s", "always", "w₁ of a method with two stages"),
    "euler_first_solution": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
}
"""Of ROS2, and of the adjoint of implicit stages."""

NEWTON_WORKSPACE: Group = {
    "base_position": Field("node", 1, "vec3", "m", "always", "q₀ that a stage starts from"),
    "base_euler": Field("node", 2, "scalar", "m", "always", "the same of (u, v)"),
    "base_velocity": Field("node", 1, "vec3", "m/s", "always", "v₀"),
    "base_euler_velocity": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "direction": Field("node", 1, "vec3", "m/s", "always", "δ"),
    "euler_direction": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "solution_before": Field("node", 1, "vec3", "m/s", "always", "w before the step along δ"),
    "euler_solution_before": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "node_mass": Field("node", 1, "scalar", "kg", "always", "half of each segment's at its nodes"),
    "carried_time": Field("world", 1, "scalar", "s", "always", "t by which a stage's velocity carries on"),
    "carried_rate": Field("world", 1, "scalar", "", "always", "k by which its gain of velocity carries on"),
    "unit": Field("world", 1, "scalar", "", "always", "1"),
    "stage_shares": Field("world", 6, "scalar", "", "always", "of stages in a step: three, its start's, and two there"),
    "newton_tolerance": Field("world", 1, "scalar", "", "always", "of what is left of the velocities to find"),
    "inner_tolerance": Field("world", 1, "scalar", "", "always", "of the linear solves in an iteration"),
    "residual_norm": Field("world", 1, "scalar", "√J", "always", "‖r‖, and ‖ρ‖ of an adjoint solve"),
    "directional_derivative": Field("world", 1, "scalar", "J", "always", "r·δ"),
    "kinetic": Field("world", 1, "scalar", "J", "always", "g·M g of the change of velocity g"),
    "kinetic_left": Field("world", 1, "scalar", "J", "always", "δ·M δ"),
    "last_norm": Field("world", 1, "scalar", "√J", "always", "‖δ‖ of the last step"),
    "change": Field("world", 1, "scalar", "√J", "always", "of velocities in the stage, or the first one's"),
    "first_change": Field("world", 1, "scalar", "√J", "always", "the first one's"),
    "contraction": Field("world", 1, "scalar", "", "always", "of the last two steps"),
    "step_length": Field("world", 1, "scalar", "", "always", "α of the line search"),
    "shortest": Field("world", 1, "scalar", "m", "always", "smallest Δs"),
    "steps": Field("world", 1, "int", "", "always", "along a δ in this stage"),
    "newton_iterations": Field("world", 1, "int", "", "always", "in this step"),
    "iterate": Field("world", 1, "int", "", "always", "whether to go on"),
    "take_unchecked_step": Field("world", 1, "int", "", "always", "whether the step along δ ends the stage"),
    "new_direction": Field("world", 1, "int", "", "always", "whether to solve for another δ"),
    "rebuild_matrix": Field("world", 1, "int", "", "always", "whether the next evaluation brings a matrix along"),
    "asks_for_compression": Field("world", 1, "int", "", "always", "whether the next solve sees what is compressed"),
    "order_would_be_lost": Field("world", 1, "int", "", "always", "whether crossings would pass at the start"),
}
"""Of implicit stages and Newton's iteration."""

COMPRESSION: Group = {
    "compressed": Field("world", 1, "int", "", "Newton's iteration", "whether solves are of A − G"),
    "indefinite": Field("world", 1, "int", "", "Newton's iteration", "whether one found that to be indefinite"),
    "compression": Field("node", 2, "vec4", "", "Newton's iteration", "(t, g [kg]) of the segments behind a node"),
    "before": Field("node", 2, "int", "", "Newton's iteration", "the node before on its warp and weft yarn, or -1"),
}
"""Of what compressed yarns take from the matrix (``kernels/linear/beside.py``)."""

ERROR_ESTIMATE: Group = {
    "predicted": Field("node", 1, "vec3", "m/s", "always", "w₂ that the first stage's acceleration leads to"),
    "missing": Field("world", 1, "scalar", "", "always", "c by which what it is off makes an error"),
    "step_error": Field("world", 1, "scalar", "m", "always", "of the node that is farthest off"),
}
"""Of steps whose error is controlled."""

ENERGY_WATCH: Group = {
    "energy": Field("world", 1, "scalar", "J", "always", "T, and what is looked at in audits alone"),
    "elastic_energy": Field("world", 1, "scalar", "J", "always", "of stretch and pins"),
    "height_energy": Field("world", 1, "scalar", "J", "always", "of gravity"),
    "power": Field("world", 2, "scalar", "W", "always", "of outer forces, and of those at the step's beginning"),
    "stage_work": Field("world", 1, "scalar", "J", "always", "of the stages of this step"),
    "bounds": Field("world", 7, "scalar", "J", "always", "what stepping/energy_watch.py remembers of steps before"),
    "steps_to_audit": Field("world", 1, "int", "", "always", "until all energies are added up again"),
    "audit_due": Field("world", 1, "int", "", "always", "whether the next step begins with that"),
    "alert": Field("world", 1, "int", "", "always", "steps that are still looked at closely"),
    "looks_closely": Field("world", 1, "int", "", "always", "whether this one is"),
    "damps": Field("world", 1, "int", "", "always", "1 of a damped part of a step, 2 of one that cannot be halved"),
    "gain": Field("world", 1, "scalar", "", "always", "part of the energy that a step may gain"),
    "still_energy": Field("world", 1, "scalar", "J", "always", "energy that may always be gained: rounding"),
}
"""Of the watch over energy (``kernels/stepping/energy_watch.py``)."""

OUTER_FORCES: Group = {
    "outer_force": Field("node", 1, "vec3", "N", "always", "of wind and applied forces at the step's beginning"),
}
"""Of that watch, where wind or applied forces do work."""

MOVING: Group = {**STATE, **SLOPES}
"""What a step changes."""

FRAMES: Group = {f"frame_{name}": dataclasses.replace(field, element="frame node") for name, field in MOVING.items()}
FRAMES["frame_euler"] = dataclasses.replace(FRAMES["frame_euler"], when="sliding")
"""Of what moves, a chunk of frames."""

KEPT: Group = {f"kept_{name}": field for name, field in (*MOVING.items(), ("bounds", ENERGY_WATCH["bounds"]))}
"""The beginning of a part of a step, which may have to be made again."""

LOSS: Group = {f"loss_{name}": dataclasses.replace(field, element="frame node") for name, field in STATE.items()}
"""What a loss asks of each frame of a chunk: its gradient by the state."""

ADJOINT: Group = {
    "adjoint_rhs": Field("node", 1, "vec3", "of the loss", "always", "right-hand side of an adjoint solve"),
    "euler_adjoint_rhs": Field("node", 2, "scalar", "of the loss", "sliding", "the same of (u, v)"),
    "euler_next": Field("node", 2, "scalar", "m", "sliding", "(u, v) at the end of the step"),
    "anchor_next": Field("node", 2, "scalar", "m", "friction", "anchors at the end of the step"),
}
"""Of the adjoint of every method."""

CARRIED_ADJOINT: Group = {
    "stage_adjoint": Field("node", 1, "vec3", "of the loss", "always", "w̄ of a stage, from what it leads to"),
    "euler_stage_adjoint": Field("node", 2, "scalar", "of the loss", "sliding", "the same of (u, v)"),
}
"""Of the adjoint of methods with stages."""

STAGE_ADJOINT: Group = {
    "zero": Field("node", 1, "vec3", "", "always", "0 in place of w̄"),
    "euler_zero": Field("node", 2, "scalar", "", "sliding", "the same of (u, v)"),
    "first_residual_norm": Field("world", 1, "scalar", "", "always", "‖ρ‖ at the start of an adjoint solve"),
    "adjoint_tolerance": Field("world", 1, "scalar", "", "always", "of ‖ρ‖, relative to that"),
}
"""Of the adjoint of implicit stages."""

LAUNCH: Group = {
    "matrix": Field("launch", 1, "int", "", "always", "whether a term is to fill the matrix"),
    "add_contact_load": Field("launch", 1, "int", "", "always", "whether a term is to add to ``contact_load``"),
    "stage": Field("launch", 1, "int", "", "always", "which stage of the step, from 0"),
    "held_by": Field("launch", 1, "int", "", "always", "0 nothing, 1 obstacles that are touched, 2 pins"),
    "along": Field("launch", 1, "int", "", "always", "direction of lines: 0 warp, 1 weft"),
    "first": Field("launch", 1, "int", "", "always", "first node of a level"),
    "count": Field("launch", 1, "int", "", "always", "nodes of a level"),
    "thread": Field("launch", 1, "int", "", "always", "which thread of a shared solve, from 0"),
    "most_iterations": Field("launch", 1, "int", "", "always", "of a linear solve"),
    "by": Field("launch", 1, "int", "", "always", "steps to count, 1 or -1"),
    "by_stages": Field("launch", 1, "int", "", "always", "whether ``stage_work`` was added up"),
    "step_duration": Field("launch", 1, "scalar", "s", "always", "h of a whole step"),
    "is_last": Field("launch", 1, "int", "", "always", "whether what is in the way is a failure"),
    "moves": Field("launch", 1, "int", "", "always", "whether to look at where a step would lead"),
    "grid": Field("launch", 1, "uint64", "", "always", "Warp's hash grid"),
    "gaps": Field("launch", 1, "vec4", "1, m", "always", "(n, g) of what is near"),
    "contact_forces": Field("launch", 1, "vec3", "N", "always", "of what touches"),
    "source": Field("launch", 1, "any", "", "always", "array to copy"),
    "target": Field("launch", 1, "any", "", "always", "array to copy into"),
    "origin": Field("launch", 1, "vec3", "m", "always", "where positions are counted from"),
    "array": Field("launch", 1, "any", "", "always", "array to clear"),
    "path": Field("launch", 1, "vec3", "", "always", "an input's rows, step after step"),
    "values": Field("launch", 1, "vec3", "", "always", "an input in this step"),
    "motion": Field("launch", 1, "vec3", "m", "always", "how far it goes in the step"),
    "share": Field("launch", 1, "scalar", "", "always", "of a stage's slope in that of a step"),
    "is_first": Field("launch", 1, "int", "", "always", "whether it is the first stage that gives to it"),
    "is_whole": Field("launch", 1, "int", "", "always", "the same, going back: the last to be reversed"),
    "start": Field("launch", 1, "vec3", "", "always", "where an iteration, or a path, starts"),
    "euler_start": Field("launch", 1, "scalar", "m/s", "always", "the same of (u, v)"),
    "time": Field("launch", 1, "scalar", "s", "always", "t by which a stage's velocity carries on"),
    "rate": Field("launch", 1, "scalar", "", "always", "k by which its gain of velocity carries on"),
}
"""What launches say themselves."""

GROUPS: dict[str, Group] = {
    "Topology": TOPOLOGY,
    "Parameters": PARAMETERS,
    "Inputs": INPUTS,
    "State": STATE,
    "Step": STEP,
    "Assembly": ASSEMBLY,
    "LinearWorkspace": LINEAR_WORKSPACE,
    "ThreadsWorkspace": THREADS_WORKSPACE,
    "Levels": LEVELS,
    "Contact": CONTACT,
    "ContactInputs": CONTACT_INPUTS,
    "Crimp": CRIMP,
    "Stages": STAGES,
    "FirstStage": FIRST_STAGE,
    "NewtonWorkspace": NEWTON_WORKSPACE,
    "Slopes": SLOPES,
    "ExplicitStage": EXPLICIT_STAGE,
    "Compression": COMPRESSION,
    "ErrorEstimate": ERROR_ESTIMATE,
    "EnergyWatch": ENERGY_WATCH,
    "OuterForces": OUTER_FORCES,
    "Frames": FRAMES,
    "Kept": KEPT,
    "Loss": LOSS,
    "Adjoint": ADJOINT,
    "CarriedAdjoint": CARRIED_ADJOINT,
    "ExplicitAdjoint": EXPLICIT_ADJOINT,
    "StageAdjoint": STAGE_ADJOINT,
    "Launch": LAUNCH,
}
FIELDS: Group = {name: field for group in GROUPS.values() for name, field in group.items()}
