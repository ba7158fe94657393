"""Checks of the machine: what works, what is missing, how to get it.

Everything that may crash or hang (drivers, compiled packages) is tried in other processes with a time limit, all at the
same time.
"""

from reconstruction.core.plugins import installed_plugins
from reconstruction.doctor.check import Check, format_checks
from reconstruction.doctor.machine import (
    disk_check,
    memory_check,
    numba_cache_check,
    registry_check,
    rendering_fix,
)
from reconstruction.doctor.packages import PIP, exports_check, opencv_check, packages_check, python_check
from reconstruction.doctor.process import finish, finish_checks, start_call

__all__ = ["Check", "format_checks", "run_checks"]
_TRIALS = "reconstruction.doctor.trials"
_PLUGINS = "plugins (optional)"


def run_checks() -> list[Check]:
    """Run all checks; takes a few seconds."""
    decoding, physics, rendering, cuda = (
        start_call(_TRIALS, name) for name in ("decoding", "physics", "rendering", "cuda")
    )
    learned = start_call("reconstruction.doctor.learned", "learned_checks")
    plugins = start_call("reconstruction.doctor.plugins", "plugin_checks") if installed_plugins() else None
    reinstall = f"{PIP} install --force-reinstall "
    cuda_fix = "for the GPU backends only: install a CUDA build of torch, then simrecon[gpu]"
    return [
        python_check(),
        packages_check(),
        exports_check(),
        opencv_check(),
        numba_cache_check(),
        memory_check(),
        disk_check(),
        registry_check(),
        finish("video decoding", decoding, reinstall + "av", True),
        finish("physics", physics, reinstall + "sapien", True),
        finish("rendering", rendering, rendering_fix(), False),
        finish("CUDA (optional)", cuda, cuda_fix, False),
        *finish_checks("learned models (optional)", learned),
        *(
            finish_checks(_PLUGINS, plugins)
            if plugins
            else [Check(_PLUGINS, True, "no package adds a backend or a task (docs/extending.md)", "", False)]
        ),
    ]
