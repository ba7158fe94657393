"""Check dtype and shape of the array fields of dataclasses, from their annotations."""

from functools import cache
from typing import Annotated, get_args, get_origin, get_type_hints

import numpy as np


class CheckedArrays:
    """Base of dataclasses: checks dtype and shape of every array field at construction.

    The annotation says dtype and axes, e.g. `points: Annotated[np.ndarray, "float64 p 3"]`. Axes of the same name have
    the same length in all fields of the class. A field that is None passes.

    Raises:
        ValueError: a field has another dtype, rank or length; names the class and the field.
    """

    def __post_init__(self) -> None:
        """Check all array fields."""
        lengths: dict[str, int] = {}
        for name, (dtype, *axes) in _array_fields(type(self)).items():
            array = getattr(self, name)
            if array is None:
                continue
            shape = np.shape(array)
            fits = len(shape) == len(axes) and all(
                size == (int(axis) if axis.isdigit() else lengths.setdefault(axis, size))
                for axis, size in zip(axes, shape)
            )
            if not fits or getattr(array, "dtype", None) != dtype:
                known = "".join(f", {axis} = {lengths[axis]}" for axis in axes if axis in lengths)
                raise ValueError(
                    f"{type(self).__name__}.{name}: expected {dtype} ({', '.join(axes)}){known}; "
                    f"got {getattr(array, 'dtype', type(array).__name__)} {shape}"
                )


@cache
def _array_fields(owner: type) -> dict[str, list[str]]:
    """Return dtype and axes of the annotated fields of a class, by name."""
    hints = get_type_hints(owner, include_extras=True)
    return {name: get_args(hint)[1].split() for name, hint in hints.items() if get_origin(hint) is Annotated}
