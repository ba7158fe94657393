"""Save and load the dataclasses of `reconstruction.core.types`: arrays as .npy, the rest as strict JSON. No pickle.

A dataclass becomes a folder: `data.json` holds plain values and the structure, every array is one `.npy` beside it,
numbered in the order met. Large arrays load memory-mapped, so a stage reads only what it touches.
"""

import dataclasses
import json
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from registry.errors import BundleError

T = TypeVar("T")
_MMAP_ABOVE_BYTES = 1 << 22


def save(value: Any, folder: Path) -> None:
    """Write a dataclass of arrays and plain values into `folder` (created, must be empty)."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays: list[np.ndarray] = []

    def encode(item: Any) -> Any:
        if dataclasses.is_dataclass(item):
            return {f.name: encode(getattr(item, f.name)) for f in dataclasses.fields(item)}
        if isinstance(item, np.ndarray):
            arrays.append(item)
            return {"array": len(arrays) - 1}
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, tuple | list):
            return [encode(x) for x in item]
        if isinstance(item, dict):
            return {str(k): encode(v) for k, v in item.items()}
        if item is None or isinstance(item, bool | int | float | str):
            return item
        raise TypeError(f"cannot save a {type(item).__name__} in an artifact")

    data = encode(value)
    for number, array in enumerate(arrays):
        np.save(folder / f"{number:05d}.npy", array, allow_pickle=False)
    (folder / "data.json").write_text(json.dumps(data, allow_nan=False))


def load(cls: type[T], folder: Path) -> T:
    """Read what `save` wrote as an instance of `cls`.

    Raises:
        BundleError: it was written by a version of the program whose dataclass has other fields.
    """

    def decode(hint: Any, item: Any) -> Any:
        origin = typing.get_origin(hint)
        if origin in (typing.Union, types.UnionType):
            if item is None:
                return None
            return decode(next(a for a in typing.get_args(hint) if a is not type(None)), item)
        if dataclasses.is_dataclass(hint):
            hints = typing.get_type_hints(hint)
            if set(item) != {f.name for f in dataclasses.fields(hint)}:
                raise BundleError(f"{folder}: its {hint.__name__} is of another version of the program")
            return hint(**{f.name: decode(hints[f.name], item[f.name]) for f in dataclasses.fields(hint)})
        if hint is np.ndarray:
            path = folder / f"{item['array']:05d}.npy"
            large = path.stat().st_size > _MMAP_ABOVE_BYTES
            return np.load(path, mmap_mode="r" if large else None, allow_pickle=False)
        if origin is tuple:
            inner = typing.get_args(hint)
            if len(inner) == 2 and inner[1] is Ellipsis:
                return tuple(decode(inner[0], x) for x in item)
            return tuple(decode(a, x) for a, x in zip(inner, item))
        if origin is list:
            return [decode(typing.get_args(hint)[0], x) for x in item]
        return item

    return decode(cls, json.loads((folder / "data.json").read_text()))
