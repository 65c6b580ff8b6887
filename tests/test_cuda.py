"""Ready for CUDA: tests/compile_cuda.py finds what does not compile, and the contact is not contracted."""

import re

import pytest
import warp as wp
from warp_yarn.kernels import Variant, build


@pytest.fixture
def compile_cuda():
    import compile_cuda

    return compile_cuda


def test_every_kernel_of_a_variant_is_compiled(compile_cuda):
    every = compile_cuda.modules(compile_cuda.variants(quick=False))
    quick = compile_cuda.modules(compile_cuda.variants(quick=True))
    assert set(quick) < set(every)
    # those of impact zones, which know double alone, are of no variant
    kinds = {name.removeprefix("warp_yarn_").partition("_float")[0] for name in every if "_float" in name}
    assert {"terms", "contact", "energy", "conjugate_gradient", "stage"} <= kinds
    # every kind of module at both precisions, and every kernel by that
    for scalar in ("float32", "float64"):
        assert {name.removeprefix("warp_yarn_").partition("_float")[0] for name in quick if scalar in name} == kinds
    assert {"warp_yarn_terms_float32_sliding_reverse", "warp_yarn_terms_float64_locked_reverse"} <= set(quick)


@pytest.mark.slow
def test_code_that_is_not_cuda_is_found(compile_cuda, tmp_path, monkeypatch, capfd):
    def define(name, snippet):
        @wp.func_native(snippet)
        def native(x: float) -> float: ...

        @wp.kernel(module=name, enable_backward=False)
        def kernel(x: wp.array(dtype=float)):
            x[0] = native(x[0])

    define("test_cuda_whole", "return x + x;")
    define("test_cuda_broken", "return std::nowhere(x);")
    wp.init()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    failed = compile_cuda.failures(["test_cuda_whole", "test_cuda_broken"], 90)
    assert list(failed) == ["test_cuda_broken"]
    # the compiler says what is wrong
    assert "nowhere" in capfd.readouterr().err
    monkeypatch.setattr(compile_cuda, "modules", lambda variants: ["test_cuda_broken"])
    assert compile_cuda.main(["--quick"]) == 1
    told = capfd.readouterr()
    assert "test_cuda_broken does not compile for sm_90" in told.err
    assert "0 of 1 modules" in told.out


@pytest.mark.slow
def test_the_contact_is_not_contracted(tmp_path):
    """A cross product is two products and a difference, as on the CPU."""
    variant = Variant(wp.float64, False)
    build(variant)
    (path,) = wp.compile_aot_module(variant.module("contact"), arch=90, module_dir=tmp_path, use_ptx=True)
    code = path.read_text()
    contracted, products = (len(re.findall(rf"\b{name}\.rn\.f64", code)) for name in ("fma", "mul"))
    # what is left belongs to divisions and square roots; contracted there are more of them than of products
    assert 0 < contracted < products / 2, (contracted, products)
