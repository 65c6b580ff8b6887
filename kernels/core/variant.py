"""What kernels are compiled for, and what a term has to say of itself."""

import dataclasses
from collections.abc import Callable

import warp as wp


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

    @property
    def forward(self) -> "Variant":
        """The variant without reverse mode, of kernels that never need it."""
        return dataclasses.replace(self, reverse=False)

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
    def sym33(self) -> type:
        """A symmetric matrix: 00, 01, 02, 11, 12, 22."""
        return wp.types.vector(6, self.scalar)

    def module(self, name: str) -> str:
        """Name of the Warp module that this variant's kernels of one kind are compiled into.

        One module a variant: typing.Any kernels would rebuild their module at every new instantiation.
        """
        parts = ["warp_yarn", name, self.scalar.__name__, "sliding" if self.sliding else "locked"]
        return "_".join(parts + ["reverse"] * self.reverse)

    def fuse(self, module: str) -> None:
        """Lets the CPU's compiler contract a b + c in one of this variant's modules, which Warp's own fuse_fp does not:
        every operation of a kernel is a statement of its own."""
        flags = wp.config.cpu_compiler_flags
        flags = "-march=native" if flags is None else flags
        wp.set_module_options({"cpu_compiler_flags": f"{flags} -ffp-contract=fast"}, self.module(module))

    def kernel(self, module: str) -> Callable[[Callable], wp.Kernel]:
        """Decorator of a kernel of this variant in one of its modules."""
        return wp.kernel(module=self.module(module), enable_backward=self.reverse)


@dataclasses.dataclass(frozen=True)
class Term:
    """One physical effect, as the simulator sees it.

    A kernel's arguments are found by name among the simulator's arrays (``warp_yarn.device.arrays``), so a kernel says
    itself what it reads and writes.
    """

    name: str
    elements: str
    """What the kernel runs over: nodes, crossings, segments, bends, triangles or pins."""
    define: Callable[[Variant], wp.Kernel]
    energy: Callable[[Variant], wp.Kernel] | None = None
    """The kernel that adds up the term's energy, where it has one."""
    stencil: int = 0
    """Neighbours that the term couples in the matrix: 0 none, 2 the next crossings of each yarn, 4 the second
    next as well, 6 the diagonal ones as well."""
    needs_contact: bool = False
    """Whether the term reads the contact force of every crossing."""
    touches: bool = False
    """Whether the term is contact, whose energies are told together."""
    sliding_only: bool = False
    """Whether the term vanishes identically where yarns do not slide."""
    presses: bool = False
    """Whether the term presses yarns together (eq. 3): its kernel then adds to ``contact_load`` where ``press`` is not
    0. Such terms stand before those that need the contact."""
