"""Arrays of what touches, and of what presses crossings: groups of ``declarations.py``."""

from .fields import Field, Group

CONTACT: Group = {
    "touching": Field("world", 3, "int", "", "always", "whether anything touches, two nodes, anything so fast"),
    "obstacle_velocity": Field("obstacle", 1, "vec3", "m/s", "obstacles", "ṗ"),
    "obstacle_spin": Field("obstacle", 1, "vec3", "rad/s", "obstacles", "ω"),
    "face_room": Field("count", 1, "int", "", "always", "places of a sample in the list of faces that are near"),
    "face_count": Field("sample", 1, "int", "", "obstacles", "how many of them are taken"),
    "near_face": Field("near face", 1, "int", "", "obstacles", "faces that are near it, of all meshes"),
    "near_room": Field("count", 1, "int", "", "always", "places of a sample in the list of what is near"),
    "near_count": Field("sample", 1, "int", "", "self-contact", "how many of them are taken"),
    "near": Field("near", 1, "int", "", "self-contact", "samples that are near it"),
    "touch_room": Field("count", 1, "int", "", "always", "places of a sample in the list of what touches it"),
    "touch_count": Field("sample", 1, "int", "", "self-contact", "how many of them are taken"),
    "touch": Field("touch", 1, "int", "", "self-contact", "samples that touched it when the matrix was filled"),
    "touch_block": Field("touch", 1, "sym33", "kg", "self-contact", "their blocks of the matrix"),
    "near_position": Field("sample", 1, "vec3", "m", "self-contact", "where they were when the list was made"),
    "outdated": Field("world", 1, "int", "", "self-contact", "whether it has to be made anew"),
    "node_segments": Field("node", 4, "int", "", "middles", "segments at a node, or -1"),
    "sample_is_free": Field("sample", 1, "int", "", "middles", "0 where any of its nodes is held, else 1"),
    "sample_moves": Field("sample", 1, "int", "", "middles", "0 where all of its nodes are held, else 1"),
    "sample_force": Field("sample", 1, "vec3", "N", "middles", "on samples, to be scattered to nodes"),
    "sample_block": Field("sample", 1, "mat33", "kg", "middles", "the same of the matrix"),
    "taken_by": Field("node", 1, "int", "", "middles", "the obstacle that a node starts a stage beside, from 1, or 0"),
} | {
    f"sample_{name}": Field("sample", 1, "vec3", unit, "middles", "what samples have of that of nodes")
    for name, unit in (
        ("position", "m"),
        ("base_position", "m"),
        ("velocity", "m/s"),
        ("increment", "m/s"),
        ("direction", "m/s"),
        ("solution", "m/s"),
    )
}
"""What contact finds (``kernels/contact``)."""

CONTACT_INPUTS: Group = {
    "contact_stiffness": Field("world", 1, "scalar", "N/m", "obstacles", "κ of a sample on an obstacle"),
    "contact_distance": Field("world", 1, "scalar", "m", "obstacles", "D"),
    "contact_range": Field("world", 1, "scalar", "m", "obstacles", "d̂"),
    "contact_slip_speed": Field("world", 1, "scalar", "m/s", "obstacles", "ε"),
    "contact_damping_speed": Field("world", 1, "scalar", "m/s", "obstacles", "v_d"),
    "self_contact_stiffness": Field("world", 1, "scalar", "N/m", "self-contact", "κ of a sample on another"),
    "self_contact_distance": Field("world", 1, "scalar", "m", "self-contact", "D"),
    "self_contact_range": Field("world", 1, "scalar", "m", "self-contact", "d̂"),
    "self_contact_slip_speed": Field("world", 1, "scalar", "m/s", "self-contact", "ε"),
    "self_contact_damping_speed": Field("world", 1, "scalar", "m/s", "self-contact", "v_d"),
    "contact_friction": Field("world", 1, "scalar", "", "self-contact", "μ of cloth on cloth"),
    "near_margin": Field("world", 1, "scalar", "m", "self-contact", "beyond D + d̂ of the list of what is near"),
    "rest_place": Field("sample", 2, "scalar", "m", "self-contact", "(u, v) at rest, far apart on different cloths"),
    "obstacle_shape": Field("obstacle", 1, "int", "", "obstacles", "as contact/distances.py numbers them"),
    "obstacle_size": Field("obstacle", 1, "vec3", "m", "obstacles", "what a shape has for numbers"),
    "obstacle_friction": Field("obstacle", 1, "scalar", "", "obstacles", "μ"),
    "obstacle_position": Field("obstacle", 1, "vec3", "m", "obstacles", "p at the time of a stage"),
    "obstacle_rotation": Field("obstacle", 1, "quat", "", "obstacles", "R"),
    "obstacle_position_before": Field("obstacle", 1, "vec3", "m", "obstacles", "p at the time of the state before"),
    "obstacle_rotation_before": Field("obstacle", 1, "quat", "", "obstacles", "R"),
    "obstacle_position_start": Field("obstacle", 1, "vec3", "m", "obstacles move", "p before the first step"),
    "obstacle_rotation_start": Field("obstacle", 1, "quat", "", "obstacles move", "R"),
    "obstacle_position_path": Field("obstacle step", 1, "vec3", "m", "obstacles move", "p after every step"),
    "obstacle_rotation_path": Field("obstacle step", 1, "quat", "", "obstacles move", "R"),
    "meshes": Field("obstacle", 1, "uint64", "", "obstacles", "Warp's mesh, or 0"),
    "first_face": Field("obstacle", 1, "int", "", "obstacles", "of a mesh, among all faces"),
    "face_obstacle": Field("face", 1, "int", "", "obstacles", "the mesh of a face"),
    "mesh_corner": Field("face", 3, "vec3", "m", "obstacles", "three of each face, in the mesh's frame"),
}
"""What a scene says of contact. What it does not have is not in the arrays at all."""

CRIMP: Group = {
    "crimp_sides": Field("node", 1, "vec4i", "", "crimp interchange", "twice its part of each segment; < 0: straight"),
    "crimp_around": Field("node", 1, "vec4i", "", "crimp interchange", "nodes left, right, up and down, where there"),
    "crimp_corners": Field("node", 1, "vec4i", "", "crimp interchange", "corner_blocks of a crossing"),
    "contact_offset": Field("yarn", 1, "scalar", "m", "crimped contact", "half the height of its crimp as woven"),
}
"""Of crimp interchange, and of the contact force at crimped positions; others have none of it."""
