"""Choose the render backend of an environment."""

import functools

from registry import EnvironmentMissing

_BLIND_OBS_MODES = (None, "state", "state_dict", "none")


def choose_render_backend(wanted: str, obs_mode: str | None, render_mode: str | None) -> str:
    """Return ManiSkill's name of the render backend: "gpu", "cpu" or "none".

    "auto" is "none" if neither mode needs images: without a renderer an environment is faster, and needs no Vulkan
    driver.

    Raises:
        EnvironmentMissing: Images are requested, and there is no usable renderer.
    """
    pictures = obs_mode not in _BLIND_OBS_MODES or render_mode is not None
    if wanted == "auto":
        return _working_backend() if pictures else "none"
    if wanted == "none" and pictures:
        raise EnvironmentMissing(
            f"render_backend='none' gives no pictures (obs_mode={obs_mode!r}, render_mode={render_mode!r}); "
            "leave render_backend out, or choose obs_mode='state' without a render_mode"
        )
    return wanted


@functools.lru_cache(maxsize=1)
def _working_backend() -> str:
    import sapien

    try:
        device = sapien.Device("cuda")
        if device.can_render():
            return "gpu"
    except RuntimeError:
        pass  # no CUDA device: try the CPU driver (Mesa's lavapipe)
    try:
        sapien.render.RenderSystem(sapien.Device("cpu"))
    except RuntimeError as error:
        raise EnvironmentMissing(
            f"SAPIEN found nothing to render with ({error}): a Vulkan driver is missing or too old. "
            "`simrecon doctor` says what to install (tools/setup_system.sh does it); "
            "obs_mode='state' without a render_mode works without one"
        ) from error
    return "cpu"
