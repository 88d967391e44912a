"""Flags of XLA that make programs which run once or twice compile quickly."""

import os
import subprocess
import sys

_LAZY = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
_WHOLE = f"{_LAZY} --xla_cpu_parallel_codegen_split_count=1"
_QUICK = (f"{_WHOLE} --xla_cpu_use_fusion_emitters=false", _WHOLE, _LAZY)
"""The first that this release of XLA knows is taken; that of jax 0.12 has fewer flags."""


def compile_quickly() -> None:
    """Have JAX compile quickly, in this process and in those that are started from here: most
    programs of a test run once, and to make them fast takes longer than to run them. vcal's own
    options give way to these flags.

    XLA ends a process that has a flag it does not know, so it is asked in another one.
    """
    if "XLA_FLAGS" in os.environ:
        return
    asked = [sys.executable, "-c", "import jax; jax.devices()"]
    for flags in _QUICK:
        quick = os.environ | {"XLA_FLAGS": flags}
        if not subprocess.run(asked, env=quick, capture_output=True, check=False).returncode:
            os.environ["XLA_FLAGS"] = flags
            return
