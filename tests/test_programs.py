"""Counts of programs: equations, and the kernels that XLA's text of a GPU program contains."""

import jax
import jax.numpy as jnp
import pytest

from benchmarks import gpu_kernels, programs
from benchmarks.entries import ENTRIES
from benchmarks.suite import FILE, Baseline, Outcome
from jaxcon.staging.batch_last import call


def test_equations_within_calls_loops_and_native_functions_count():
    def doubled(x):
        return x + x

    def function(x):
        y = call(lambda x: jnp.sin(x) * x, x)
        y, _ = jax.lax.scan(lambda y, _: (y - 1.0, None), y, length=3)
        return jax.jit(doubled)(y)

    assert programs.equations(function, jnp.float32(0.5)) == 4


def test_three_small_scenes_are_no_longer_than_before():
    """The counts are those of the version of JAX with which the baseline was made."""
    baseline = Baseline.read(FILE)
    metrics = ENTRIES["programs"].run(True).metrics
    assert len(metrics) == 6
    if baseline.machines["quick"]["programs"]["jax"] == jax.__version__:
        assert baseline.worse("quick", {"programs": Outcome(metrics)}) == []
    else:  # other versions trace a few equations more or less
        before = baseline.of("quick", "programs")
        assert all(m.value < 1.25 * before[m.name] for m in metrics)


TEXT = """
HloModule jit_step, entry_computation_layout={(f32[3,8]{1,0})->f32[3,8]{1,0}}

%fused (p: f32[3,8], q: f32[100,8]) -> f32[3,8] {
  %p = f32[3,8]{1,0} parameter(0)
  %q = f32[100,8]{1,0} parameter(1)
  %part = f32[3,8]{1,0} slice(%q), slice={[0:3], [0:8]}
  ROOT %sum = f32[3,8]{1,0} add(%p, %part)
}

%body (s: (s32[], f32[3,8])) -> (s32[], f32[3,8]) {
  %s = (s32[], f32[3,8]{1,0}) parameter(0)
  %i = s32[] get-tuple-element(%s), index=0
  %x = f32[3,8]{1,0} get-tuple-element(%s), index=1
  %copy = f32[3,8]{1,0} copy(%x)
  ROOT %t = (s32[], f32[3,8]{1,0}) tuple(%i, %copy)
}

%condition (s: (s32[], f32[3,8])) -> pred[] {
  %s = (s32[], f32[3,8]{1,0}) parameter(0)
  %i = s32[] get-tuple-element(%s), index=0
  %n = s32[] constant(5)
  ROOT %less = pred[] compare(%i, %n), direction=LT
}

ENTRY %main (a: f32[3,8], b: f32[100,8]) -> f32[3,8] {
  %a = f32[3,8]{1,0} parameter(0)
  %b = f32[100,8]{1,0} parameter(1)
  %sum = f32[3,8]{1,0} fusion(%a, %b), kind=kLoop, calls=%fused
  %zero = s32[] constant(0)
  %start = (s32[], f32[3,8]{1,0}) tuple(%zero, %sum)
  %loop = (s32[], f32[3,8]{1,0}) while(%start), condition=%condition, body=%body KNOWN
  ROOT %end = f32[3,8]{1,0} get-tuple-element(%loop), index=1
}
"""


@pytest.mark.parametrize(
    ("trips", "kernels"),
    [
        # the fusion reads 3 of 100 rows; the loop copies 96 B, which are read and written
        (', backend_config={"known_trip_count":{"n":"5"}}', (1 + 5, 3 * 96 + 5 * 2 * 96, 0)),
        # of a loop of unknown length, one iteration and its condition, which reads two integers
        ("", (1 + 1 + 1, 3 * 96 + 2 * 96 + 9, 1)),
    ],
)
def test_kernels_are_read_from_the_text_of_a_program(trips, kernels):
    program = gpu_kernels.Program(TEXT.replace(" KNOWN", trips))
    assert program.kernels() == gpu_kernels.Kernels(*kernels)


@pytest.mark.skipif(not gpu_kernels.is_available(), reason="needs XLA's compiler for CUDA")
def test_a_sum_is_one_kernel():
    x = jax.ShapeDtypeStruct((1024,), jnp.float32)
    assert gpu_kernels.count(lambda x: x + 2 * x, x) == gpu_kernels.Kernels(1, 2 * 4096, 0)
