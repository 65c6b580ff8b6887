"""Arrays of methods whose first stage is explicit, declared as ``declarations.py`` declares all others."""

from ..kernels.stepping.esdirk import COEFFICIENTS
from .fields import Field, Group

SLOPES: Group = {
    "slope": Field("node", 1, "vec3", "m/s²", "slopes", "of the last stage of the step before; NaN: not known"),
    "euler_slope": Field("node", 2, "scalar", "m/s²", "slopes of sliding", "the same of (u, v)"),
}
"""What a step leaves to the next beside the state, by methods whose first stage is explicit."""

EXPLICIT_STAGE: Group = {
    "start_position": Field("node", 1, "vec3", "m", "always", "x that the step started from"),
    "start_euler": Field("node", 2, "scalar", "m", "always", "(u, v)"),
    "start_velocity": Field("node", 1, "vec3", "m/s", "always", "ẋ"),
    "start_euler_velocity": Field("node", 2, "scalar", "m/s", "sliding", "(u̇, v̇)"),
    "second_solution": Field("node", 1, "vec3", "m/s", "always", "w₂"),
    "euler_second_solution": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "tableau": Field("world", COEFFICIENTS, "scalar", "", "always", "its coefficients"),
    "asks_for_slope": Field("world", 1, "int", "", "always", "whether the slope is not known"),
}
"""Of methods whose first stage is explicit (``kernels/stepping/esdirk.py``)."""

EXPLICIT_ADJOINT: Group = {
    "first_base": Field("node", 1, "vec3", "m/s", "always", "v₁ that the first implicit stage starts from"),
    "euler_first_base": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
    "second_base": Field("node", 1, "vec3", "m/s", "always", "v₂ of the second"),
    "euler_second_base": Field("node", 2, "scalar", "m/s", "sliding", "the same of (u, v)"),
}
"""Of the adjoint of methods whose first stage is explicit: only their gradients are used."""
