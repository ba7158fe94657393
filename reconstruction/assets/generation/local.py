"""TRELLIS and SAM 3D Objects on this machine, by the Python interfaces of their repositories.

TRELLIS: https://github.com/microsoft/TRELLIS (`TrellisImageTo3DPipeline.from_pretrained(...).run(image)`, then
`postprocessing_utils.to_glb`). SAM 3D Objects: https://github.com/facebookresearch/sam-3d-objects (`Inference` of its
`notebook/inference.py`, called with an image and a mask; `glb` of its result is a mesh). Both need an NVIDIA GPU and
are installed by their own instructions. Neither has been run in this project: the code follows their sources.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Any

from PIL import Image

from reconstruction.assets.generation.base import GenerationError, GeneratorUnavailable, Job, ObjectPictures
from registry.errors import EnvironmentMissing

TRELLIS_MODEL = "microsoft/TRELLIS-image-large"
_TRELLIS_PAGE = "https://github.com/microsoft/TRELLIS#-installation"
_SAM3D_PAGE = "https://github.com/facebookresearch/sam-3d-objects/blob/main/doc/setup.md"
_KEPT_SHARE = 0.95  # TRELLIS' `simplify`: share of the triangles that is removed
_TEXTURE_PX = 1024


class Trellis:
    """See `GenerationBackend`."""

    name = "trellis"
    cost = 0.0
    sends_to = ""
    most_pictures = 4
    at_once = 1

    def __init__(self, model: str, seed: int) -> None:
        """Store the model, a name on the Hugging Face hub or a folder; it is loaded with the first object."""
        self._model, self._seed = model or TRELLIS_MODEL, seed
        self._pipeline: Any = None

    def settings(self) -> dict[str, Any]:
        """See `GenerationBackend.settings`."""
        size = {"simplify": _KEPT_SHARE, "texture_size": _TEXTURE_PX}
        return {"model": self._model, "seed": self._seed, **size}

    def check(self) -> None:
        """See `GenerationBackend.check`."""
        _needs("trellis", "trellis.pipelines", _TRELLIS_PAGE)

    def generate(self, pictures: ObjectPictures, job: Job) -> bytes:
        """See `GenerationBackend.generate`."""
        pipeline, to_glb = self._load()
        images = [Image.fromarray(picture.cut_out(), "RGBA") for picture in pictures.pictures]
        formats = ["mesh", "gaussian"]
        try:
            if len(images) == 1:
                made = pipeline.run(images[0], seed=self._seed, formats=formats)
            else:
                made = pipeline.run_multi_image(images, seed=self._seed, formats=formats)
            mesh = to_glb(
                made["gaussian"][0], made["mesh"][0], simplify=_KEPT_SHARE, texture_size=_TEXTURE_PX, verbose=False
            )  # fmt: skip
            return mesh.export(file_type="glb")
        except (RuntimeError, ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
            raise GenerationError(f"TRELLIS failed ({type(error).__name__}: {_short(error)})") from error

    def _load(self) -> tuple[Any, Any]:
        if self._pipeline is None:
            try:
                from trellis.pipelines import TrellisImageTo3DPipeline  # pyright: ignore[reportMissingImports]
                from trellis.utils.postprocessing_utils import to_glb  # pyright: ignore[reportMissingImports]

                pipeline = TrellisImageTo3DPipeline.from_pretrained(self._model)
                pipeline.cuda()
            except (ImportError, OSError, RuntimeError, ValueError, AssertionError) as error:
                raise GeneratorUnavailable(
                    f"TRELLIS cannot be loaded ({type(error).__name__}: {_short(error)}); {_TRELLIS_PAGE}"
                ) from error
            self._pipeline = pipeline, to_glb
        return self._pipeline


class Sam3D:
    """See `GenerationBackend`; the model gets the object's surroundings, too."""

    name = "sam3d"
    cost = 0.0
    sends_to = ""
    most_pictures = 1
    at_once = 1

    def __init__(self, pipeline_file: str, seed: int) -> None:
        """Store the `pipeline.yaml` of the downloaded checkpoints; it is loaded with the first object."""
        self._file, self._seed = pipeline_file, seed
        self._inference: Any = None

    def settings(self) -> dict[str, Any]:
        """See `GenerationBackend.settings`."""
        return {"pipeline": Path(self._file).name if self._file else "", "seed": self._seed}

    def check(self) -> None:
        """See `GenerationBackend.check`."""
        _needs("sam3d", "sam3d_objects", _SAM3D_PAGE)
        if not self._pipeline_file().is_file():
            raise EnvironmentMissing(
                f"assets.generator=sam3d: there is no {self._pipeline_file()}; download the checkpoints "
                f"({_SAM3D_PAGE}) and name their pipeline.yaml with --set assets.generator_model=FILE"
            )

    def generate(self, pictures: ObjectPictures, job: Job) -> bytes:
        """See `GenerationBackend.generate`."""
        inference = self._load()
        best = pictures.pictures[0]
        try:
            mesh = inference(best.color, best.mask, seed=self._seed)["glb"]
            if mesh is None:
                raise GenerationError("SAM 3D Objects made no mesh of it")
            return mesh.export(file_type="glb")
        except (RuntimeError, ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
            raise GenerationError(
                f"SAM 3D Objects failed ({type(error).__name__}: {_short(error)})"
            ) from error

    def _pipeline_file(self) -> Path:
        return Path(self._file) if self._file else _repository() / "checkpoints" / "hf" / "pipeline.yaml"

    def _load(self) -> Any:
        if self._inference is None:
            folder = str(_repository() / "notebook")
            sys.path.insert(0, folder)
            try:
                from inference import Inference  # pyright: ignore[reportMissingImports]  # a file of their repository

                self._inference = Inference(str(self._pipeline_file()), compile=False)
            except (ImportError, OSError, RuntimeError, ValueError, AssertionError) as error:
                raise GeneratorUnavailable(
                    f"SAM 3D Objects cannot be loaded ({type(error).__name__}: {_short(error)}); {_SAM3D_PAGE}"
                ) from error
            finally:
                sys.path.remove(folder)
        return self._inference


def _repository() -> Path:
    """Return the folder that SAM 3D Objects was installed from (`pip install -e`)."""
    found = importlib.util.find_spec("sam3d_objects")
    if found is None or not found.submodule_search_locations:
        raise GeneratorUnavailable(f"SAM 3D Objects is not installed; {_SAM3D_PAGE}")
    return Path(next(iter(found.submodule_search_locations))).parent


def _needs(option: str, module: str, page: str) -> None:
    """Check that a module is installed, without importing it."""
    try:
        found = importlib.util.find_spec(module) is not None
    except ImportError:  # by the package around it
        found = False
    if not found:
        raise EnvironmentMissing(
            f"assets.generator={option} needs {module.split('.')[0]}, which is not installed here: {page}; or leave "
            f"that option out"
        )


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else text[:200] + "..."
