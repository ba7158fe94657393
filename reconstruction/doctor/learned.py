"""Checks of learned models, all optional: packages, weights and services are looked for, no model is loaded."""

import importlib.metadata
import os
from pathlib import Path

from reconstruction.depth.config import DepthConfig
from reconstruction.doctor.check import Check
from reconstruction.instances.masks.load import DEFAULT_MODELS
from reconstruction.instances.naming.load import DEFAULT_CLIP_MODEL
from reconstruction.learned.models import EXTRA
from reconstruction.world.config import WorldConfig

_WEIGHTS = ("*.safetensors", "*.bin")
_PATIENCE_S = 3.0  # for the answer of a service


def learned_checks() -> list[Check]:
    """Check transformers, weights of default models, the endpoint of a vision-language model, and generators."""
    return [*_models(), endpoint_check(), *generator_checks()]


def _models() -> list[Check]:
    try:
        version = importlib.metadata.version("transformers")
    except importlib.metadata.PackageNotFoundError:
        fix = f"pip install 'simrecon[{EXTRA}]', for masks, labels and depth by learned models"
        return [Check("learned models (optional)", False, "transformers is not installed", fix, False)]
    wanted = {f"instances.masks={name}": model for name, model in DEFAULT_MODELS.items()}
    wanted |= {
        "instances.labels=clip": DEFAULT_CLIP_MODEL,
        "depth.monocular=transformers": DepthConfig().monocular_model,
        "world.metric_depth=transformers": WorldConfig().metric_depth_model,
    }
    checks = [Check("learned models (optional)", True, f"transformers {version}", "", False)]
    for option, model in wanted.items():
        found = has_weights(model)
        detail = f"{model} is {'here' if found else 'not on this machine'}"
        checks.append(Check(option, found, detail, f"hf download {model}", False))
    return checks


def hub_cache() -> Path:
    """Return the cache folder of the Hugging Face hub."""
    home = Path(os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface")
    return Path(os.environ.get("HF_HUB_CACHE") or home / "hub").expanduser()


def has_weights(model: str) -> bool:
    """Return whether the weights of a model, named as on the hub, are in its cache."""
    snapshots = hub_cache() / f"models--{model.replace('/', '--')}" / "snapshots"
    return any(True for pattern in _WEIGHTS for _ in snapshots.glob(f"*/{pattern}"))


def endpoint_check() -> Check:
    """Check that the endpoint of the environment's variables answers and serves the model."""
    name = "instances.labels=vlm"
    url, model = os.environ.get("SIMRECON_VLM_URL", ""), os.environ.get("SIMRECON_VLM_MODEL", "")
    if not url or not model:
        fix = "set SIMRECON_VLM_URL and SIMRECON_VLM_MODEL to an OpenAI-compatible endpoint (docs/labels.md)"
        return Check(name, False, "no endpoint is set", fix, False)
    fix = "start the endpoint, or correct SIMRECON_VLM_URL, SIMRECON_VLM_MODEL or SIMRECON_VLM_KEY"
    try:
        served = _served_models(url)
    except (OSError, ValueError, KeyError, TypeError) as error:  # requests' errors are OSErrors
        return Check(name, False, f"{url} does not list its models ({type(error).__name__})", fix, False)
    detail = f"{url} serves {', '.join(served[:5]) or 'nothing'}"
    return Check(name, model in served, detail + ("" if model in served else f", not {model}"), fix, False)


def _served_models(url: str) -> list[str]:
    import requests

    key = os.environ.get("SIMRECON_VLM_KEY", "")
    response = requests.get(
        url.rstrip("/").removesuffix("/chat/completions") + "/models",
        headers={"Authorization": f"Bearer {key}"} if key else {},
        timeout=_PATIENCE_S,
    )
    response.raise_for_status()
    return [str(entry["id"]) for entry in response.json()["data"]]


def generator_checks() -> list[Check]:
    """Check each generator, without generating an object or sending a picture."""
    return [_rodin(), _hunyuan(), *_local_generators()]


def _rodin() -> Check:
    from reconstruction.assets.generation import GenerationError
    from reconstruction.assets.generation.rodin import RODIN_KEY, Rodin
    from reconstruction.assets.generation.service import ServiceLimits

    name = "assets.generator=rodin"
    if not os.environ.get(RODIN_KEY):
        return Check(name, False, f"{RODIN_KEY} is not set", f"set {RODIN_KEY} (docs/generation.md)", False)
    try:
        credits = Rodin("", "", 0, ServiceLimits(timeout_s=_PATIENCE_S)).balance()
    except GenerationError as error:
        return Check(name, False, str(error), f"correct {RODIN_KEY}", False)
    return Check(name, True, f"the account has {credits:g} credits", "", False)


def _hunyuan() -> Check:
    import requests

    from reconstruction.assets.generation.hunyuan import HUNYUAN_URL, HUNYUAN_VARIABLE

    name, url = "assets.generator=hunyuan3d", os.environ.get(HUNYUAN_VARIABLE) or HUNYUAN_URL
    fix = f"start its api_server.py, or set {HUNYUAN_VARIABLE} (docs/generation.md)"
    try:
        # The page exists since 2.1; "not found" is an answer, too.
        requests.get(f"{url.rstrip('/')}/health", timeout=_PATIENCE_S)
    except requests.RequestException as error:
        return Check(name, False, f"nobody answers at {url} ({type(error).__name__})", fix, False)
    return Check(name, True, f"a server answers at {url}", "", False)


def _local_generators() -> list[Check]:
    from reconstruction.assets.generation.local import Sam3D, Trellis
    from registry.errors import SimReconError

    checks = []
    for backend in (Trellis("", 0), Sam3D("", 0)):
        name = f"assets.generator={backend.name}"
        try:
            backend.check()
        except SimReconError as error:
            checks.append(Check(name, False, "not installed", str(error), False))
        else:
            checks.append(Check(name, True, "installed", "", False))
    return checks
