"""Save and load dataclasses of arrays and plain values as a folder, without pickle.

`data.json` holds structure and plain values as strict JSON. Each array is one `.npy` file, numbered in the order of
fields. Large arrays are loaded as memory maps.
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
_MMAP_ABOVE_BYTES = 1 << 22  # larger files are memory-mapped


def save(value: Any, folder: Path) -> None:
    """Write a dataclass into `folder`, which is created and must be empty.

    Raises:
        TypeError: a value is of a type that cannot be saved.
        ValueError: a number is not finite.
    """
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
        raise TypeError(f"an artifact cannot hold a {type(item).__name__}")

    data = encode(value)
    for number, array in enumerate(arrays):
        np.save(folder / f"{number:05d}.npy", array, allow_pickle=False)
    (folder / "data.json").write_text(json.dumps(data, allow_nan=False))


def load(cls: type[T], folder: Path) -> T:
    """Read a folder written by `save` as an instance of `cls`.

    Raises:
        BundleError: another version of the program wrote it, with other fields.
        ValueError: an array has another dtype or shape than its field.
    """

    def decode(hint: Any, item: Any) -> Any:
        origin = typing.get_origin(hint)
        if origin in (typing.Union, types.UnionType):
            if item is None:
                return None
            return decode(next(a for a in typing.get_args(hint) if a is not type(None)), item)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            hints = typing.get_type_hints(hint)
            if set(item) != {f.name for f in dataclasses.fields(hint)}:
                raise BundleError(f"{folder}: {hint.__name__} is of another version of the program")
            return hint(**{f.name: decode(hints[f.name], item[f.name]) for f in dataclasses.fields(hint)})
        if hint is np.ndarray:
            path = folder / f"{item['array']:05d}.npy"
            large = path.stat().st_size > _MMAP_ABOVE_BYTES
            # Copied on write: kernels are compiled for writable arrays, of whatever size.
            return np.load(path, mmap_mode="c" if large else None, allow_pickle=False)
        if origin is tuple:
            inner = typing.get_args(hint)
            if len(inner) == 2 and inner[1] is Ellipsis:
                return tuple(decode(inner[0], x) for x in item)
            return tuple(decode(a, x) for a, x in zip(inner, item))
        if origin is list:
            return [decode(typing.get_args(hint)[0], x) for x in item]
        return item

    return decode(cls, json.loads((folder / "data.json").read_text()))
