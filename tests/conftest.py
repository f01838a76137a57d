"""Configures JAX for all tests: float64, strict dtype promotion, and no rank promotion.

The tests compile much and run little. XLA's costly passes are therefore off unless XLA_FLAGS says
otherwise, which halves the time. Without fusion emitters, small programs, such as operations
outside of `jit`, compile twice as fast.
"""

import fnmatch
import gc
import os
import sys
from importlib.metadata import version
from itertools import compress
from pathlib import Path

os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    # jaxlib 0.12 lacks the fusion-emitter option and fails on an unknown option
    + " --xla_cpu_use_fusion_emitters=false"
    * (tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11)),
)

import jax
import pytest

FAST = {
    "architecture",
    "contributing",
    "couplings",
    "docs",
    "inertia",
    "islands",
    "jacobian",
    "joint_frames",
    "lanes",
    "layout",
    "losses",
    "momentum",
    "namespaces",
    "native",
    "numerics",
    "params",
    "pose",
    "programs",
    "quaternion",
    "rename",
    "scene",
    "size",
    "solvers",
    "step",
    "summaries",
}
"""Subjects whose tests have the marker `fast`; together they take four minutes on two cores."""

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    """Shares one compilation cache among all processes and runs, and collects garbage less often.

    Tracing makes millions of objects. At its default thresholds the garbage collector takes a fifth
    of the time.
    """
    gc.set_threshold(200_000, 50, 100)
    programs = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(config.cache.mkdir("jax")))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    jax.config.update("jax_compilation_cache_dir", programs)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def pytest_addoption(parser):
    parser.addoption("--thorough", action="store_true", help="also runs the cases of thorough.txt")


def pytest_collection_modifyitems(config, items):
    """Marks fast tests, and deselects the cases of `thorough.txt` unless --thorough is given.

    Raises:
        UsageError: a pattern matches no case of the whole suite.
    """
    for item in items:
        if item.path.stem.removeprefix("test_") in FAST:
            item.add_marker("fast")
    lines = Path(__file__).with_name("thorough.txt").read_text().splitlines()
    patterns = [line for line in lines if line and not line.startswith("#")]
    names = [item.nodeid.removeprefix("tests/") for item in items]
    unused = [p for p in patterns if not any(fnmatch.fnmatchcase(x, p) for x in names)]
    if unused and config.args == config.getini("testpaths"):
        raise pytest.UsageError(f"thorough.txt: no case is called {unused}")
    if config.getoption("--thorough"):
        return
    late = [any(fnmatch.fnmatchcase(x, p) for p in patterns) for x in names]
    config.hook.pytest_deselected(items=list(compress(items, late)))
    items[:] = [item for item, flag in zip(items, late, strict=True) if not flag]


def pytest_runtest_logreport(report):
    """Prints a failed test at once: a run with a time limit may not reach its summary."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        print(f"\nFAILED {report.nodeid} ({report.when})", file=sys.__stderr__, flush=True)


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """Clears compiled programs after each module: the next module does not run them."""
    yield
    jax.clear_caches()
