"""Start of processes that simulate: a fork server imports the simulator once, and each begins with it imported."""

import multiprocessing

_IMPORTED = "simrecon_envs.scene_env"


def start_method() -> str:
    """Return the start method for processes with environments, "forkserver" where there is one, else "spawn".

    The fork server of this process imports torch and ManiSkill when it starts, and makes no environment itself: a
    simulator must not be forked. One that is running already stays as it is, and its processes import for themselves.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return "spawn"
    multiprocessing.set_forkserver_preload([_IMPORTED])
    return "forkserver"
