"""Every test runs in float64, with strict promotion of dtypes and ranks.

They compile much and run little, so that XLA's costly passes are left out unless XLA_FLAGS says
otherwise: half the time. Without fusion emitters small programs, such as operations outside of
`jit`, compile twice as fast.
"""

import gc
import os
import sys
from importlib.metadata import version

os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    # jaxlib 0.12 has none of these, and stops at the name of an option that it does not know
    + " --xla_cpu_use_fusion_emitters=false"
    * (tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11)),
)

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    """Lets all that tests start, and the next run, share what was compiled; keeps garbage longer.

    Tracing makes millions of objects, which a collector at its usual pace looks through again and
    again: a fifth of the time.
    """
    gc.set_threshold(200_000, 50, 100)
    programs = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(config.cache.mkdir("jax")))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    jax.config.update("jax_compilation_cache_dir", programs)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def pytest_runtest_logreport(report):
    """Names what failed at once: a run with a limit may not reach its end."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        print(f"\nFAILED {report.nodeid} ({report.when})", file=sys.__stderr__, flush=True)


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """Lets go of what a module compiled, which the next one does not run."""
    yield
    jax.clear_caches()
