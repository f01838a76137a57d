"""`quick_jit`: jit without XLA's costly passes, for tests that compile much and run little."""

import functools
from collections.abc import Callable
from typing import Any

import jax

CHEAP = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}


@functools.cache
def options() -> dict[str, Any]:
    """Those of the cheap options that this version of XLA knows."""

    def known(name: str) -> bool:
        try:
            jax.jit(lambda: 0.0, compiler_options={name: CHEAP[name]})()
        except Exception:
            return False
        return True

    return {name: value for name, value in CHEAP.items() if known(name)}


def quick_jit(function: Callable[..., Any], **kwargs: Any) -> Callable[..., Any]:
    """jax.jit(function), compiled in a third of the time into slower code."""
    return jax.jit(function, compiler_options=options(), **kwargs)
