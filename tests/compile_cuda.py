"""Compile every kernel for CUDA, on a machine without a GPU: Warp carries the compiler.

    python tests/compile_cuda.py --quick            what .ci/run does
    python tests/compile_cuda.py --arch 75 --cubin  all variants, to the machine code of another GPU

PTX (the default) shows that the generated C++ compiles, --cubin also that it assembles. --quick compiles two of the
four forward variants and their reverses, each of general cloths too, single precision with sliding and double without:
between them every line of every kernel, and every snippet at both precisions. What is compiled lies in Warp's cache by
its content, so that a second run compiles what has changed. The compiler's messages are on stderr, and name lines of
the generated source.

It stands beside the tests since it checks and measures nothing, and is none of them since it takes a minute from an
empty cache.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import itertools
import os
import sys
from collections.abc import Iterable, Sequence

import warp as wp
from warp_yarn.kernels import Variant, build
from warp_yarn.kernels.contact import continuous


def variants(quick: bool) -> list[Variant]:
    """List what is compiled, the longest first."""
    kinds = itertools.product((wp.float64, wp.float32), (False, True))
    chosen = [(scalar, sliding) for scalar, sliding in kinds if not quick or (scalar is wp.float32) == sliding]
    every = [Variant(*kind, reverse) for reverse in (True, False) for kind in chosen]
    return [variant for plain in every for variant in (plain, dataclasses.replace(plain, general=True))]


def modules(variants: Iterable[Variant]) -> list[str]:
    """Name the Warp modules of all kernels of these variants, each once."""
    kernels = itertools.chain.from_iterable(build(variant).values() for variant in variants)
    # these are of no variant
    kernels = itertools.chain(kernels, [continuous.define().find_vertices])
    return list(dict.fromkeys(kernel.module.name for kernel in kernels))


def failures(names: Sequence[str], arch: int, cubin: bool = False) -> dict[str, str]:
    """Compile modules, several at once; return what went wrong by the module's name."""

    def message(name: str) -> str:
        try:
            wp.compile_aot_module(name, arch=arch, use_ptx=not cubin)
        except Exception as error:  # whatever Warp raises, the others are still compiled
            return f"{type(error).__name__}: {error}"
        return ""

    # the compiler is native code, and runs outside of Python's lock
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        messages = dict(zip(names, pool.map(message, names), strict=True))
    return {name: text for name, text in messages.items() if text}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="half of the variants")
    parser.add_argument("--arch", type=int, default=90, help="compute capability, times ten (%(default)s)")
    parser.add_argument("--cubin", action="store_true", help="machine code rather than PTX")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_ERROR
    names = modules(variants(options.quick))
    failed = failures(names, options.arch, options.cubin)
    for name, text in failed.items():
        print(f"{name} does not compile for sm_{options.arch}: {text}", file=sys.stderr)
    print(f"{len(names) - len(failed)} of {len(names)} modules compile for sm_{options.arch}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
