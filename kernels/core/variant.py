"""What kernels are compiled for, and what a term has to say of itself."""

import dataclasses
from collections.abc import Callable
from typing import Any

import warp as wp

ELEMENTS = (
    "nodes", "crossings", "segments", "bends", "triangles", "seams", "pins", "applied", "samples", "sample_obstacles"
)  # fmt: skip
"""What a term's kernel may run over. Samples are what touches: nodes, or points between them too."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One compilation of every kernel: the scalar type, whether yarns slide, and whether reverse mode is compiled too.

    Without sliding the branches under ``if wp.static(sliding)`` are not generated, so a scene that locks the Eulerian
    coordinates pays neither for their arithmetic nor for their arrays (which are passed as ``None``). Reverse mode
    takes as long to compile as all the rest, which a user of the forward simulation need not wait for.
    """

    scalar: type
    sliding: bool
    reverse: bool = False
    term: str = ""
    """The term from outside the package whose kernels these are: they have modules of their own."""
    general: bool = False
    """Whether a cloth's numbers are of every segment, yarn, node or corner (``core/general.py``): only kernels that
    read these are compiled for it."""

    @property
    def forward(self) -> "Variant":
        """Give the variant without reverse mode, of kernels that never need it."""
        return dataclasses.replace(self, reverse=False)

    @property
    def plain(self) -> "Variant":
        """Give the variant of cloths whose numbers are single ones, of kernels that do not read them."""
        return dataclasses.replace(self, general=False)

    @property
    def vec3(self) -> type:
        return wp.types.vector(3, self.scalar)

    @property
    def quat(self) -> type:
        return {wp.float64: wp.quatd, wp.float32: wp.quatf}[self.scalar]

    @property
    def mat33(self) -> type:
        return wp.types.matrix((3, 3), self.scalar)

    @property
    def vec4(self) -> type:
        return wp.types.vector(4, self.scalar)

    @property
    def sym33(self) -> type:
        """Give the type of a symmetric matrix: 00, 01, 02, 11, 12, 22."""
        return wp.types.vector(6, self.scalar)

    def module(self, name: str) -> str:
        """Name the Warp module that this variant's kernels of one kind are compiled into.

        One module a variant: typing.Any kernels would rebuild their module at every new instantiation.
        """
        parts = ["warp_yarn", name, *([self.term] if self.term else [])]
        parts += [self.scalar.__name__, "sliding" if self.sliding else "locked"]
        return "_".join(parts + ["general"] * self.general + ["reverse"] * self.reverse)

    def fuse(self, module: str) -> None:
        """Lets the CPU's compiler contract a b + c in one of this variant's modules, which Warp's own fuse_fp does not:
        every operation of a kernel is a statement of its own."""
        flags = wp.config.cpu_compiler_flags
        flags = "-march=native" if flags is None else flags
        wp.set_module_options({"cpu_compiler_flags": f"{flags} -ffp-contract=fast"}, self.module(module))

    def kernel(self, module: str) -> Callable[[Callable], wp.Kernel]:
        """Decorate a kernel of this variant in one of its modules."""
        return wp.kernel(module=self.module(module), enable_backward=self.reverse)


@dataclasses.dataclass(frozen=True)
class TermParameter:
    """A number, or a vector, that a term needs: an array of its name on the device, which runs have gradients by.

    The parameters of the package's own terms are arguments of Yarn, Cloth, Wind and Scene, and so without a default
    here. Those of terms that are registered come from ``Scene(parameters={name: value})``.
    """

    name: str
    unit: str
    """In SI, "" of what has none."""
    default: float | tuple[float, float, float] | None = None
    """What it is where a scene does not say; None: the scene has to."""
    least: float | None = None
    """The smallest value allowed."""
    above: float | None = None
    """What every value must be above."""
    of: str = "scene"
    """"scene": one number, ``name[0]`` in kernels, of the cloth as a whole too; "yarn": one of each material, and in
    kernels of each yarn, ``name[segment_yarn[e]]``; "crossing": one number, or in a general cloth one of each node,
    ``name[own(node)]``."""
    size: int = 1
    """3: a vector, of any values."""

    @property
    def range(self) -> dict[str, float]:
        """What it must be above, or at least."""
        ends = {"above": self.above, "least": self.least}
        return {end: value for end, value in ends.items() if value is not None}


@dataclasses.dataclass(frozen=True)
class Term:
    """One physical effect, as the simulator sees it.

    A kernel's arguments are found by name among the simulator's arrays (``warp_yarn.device.arrays``), so a kernel says
    itself what it reads and writes.
    """

    name: str
    elements: str
    """What the kernel runs over: one of ``ELEMENTS``."""
    define: Callable[[Variant], wp.Kernel]
    energy: Callable[[Variant], wp.Kernel] | None = None
    """The kernel that adds up the term's energy, where it has one."""
    parameters: tuple[TermParameter, ...] = ()
    """Those that no term before it has."""
    absent: Callable[[Any], str] | None = None
    """Says why a scene has no use for the term, or "" where it has. None: every scene has."""
    stencil: int = 0
    """Neighbours that the term couples in the matrix: 0 none, 2 the next crossings of each yarn, 4 the second
    next as well, 6 the diagonal ones as well, 8 what is sewn together."""
    needs_contact: bool = False
    """Whether the term reads the contact force of every crossing."""
    touches: bool = False
    """Whether the term is contact, whose energies are told together."""
    sliding_only: bool = False
    """Whether the term vanishes identically where yarns do not slide."""
    presses: bool = False
    """Whether the term presses yarns together (eq. 3): its kernel then adds to ``contact_load`` where
    ``add_contact_load`` is not 0. Such terms stand before those that need the contact."""
    reads_forces: bool = False
    """Whether the term reads the sum of the others' forces: it then stands last."""
    energy_watched_as: str = ""
    """The sum that the energy is added to at every step (``kernels/stepping/energy_watch.py``): "elastic_energy" of
    what is strained, "height_energy" of what may be negative, as a weight's. "": its energy is looked at now and then,
    and counts for 0 between, so it must be at least 0."""
    works: bool = False
    """Whether the term does work on the cloth and has no energy, as wind does. What can only brake need not say so."""
    explicit_in_ros2: bool = False
    """Whether ROS2 leaves the term out of its matrix. One that adds a damping D, ``coefficients[0][1]``, has to be: the
    second solve of ROS2 knows no D but friction's."""
    kept: bool = False
    """Whether an ablation never leaves the term out, as it is what is done to the cloth."""
