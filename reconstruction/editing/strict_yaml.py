"""Read a YAML file of plain values, with bounds on its size, depth and number of values; repeated keys are refused.

Values count with their aliases written out: a file of a few lines can stand for billions of values. A repeated key
would drop a value without a word.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

_MOST_BYTES = 4 << 20
_DEEPEST = 32
_MOST_VALUES = 200_000


def read_yaml(path: Path) -> Any:
    """Return the value of a YAML file in UTF-8.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not such a file; the message says why and in which line.
    """
    import yaml

    with path.open("rb") as stream:
        data = stream.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise ValueError(f"larger than {_MOST_BYTES >> 20} MB")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"not UTF-8 text: line {line} has the byte 0x{data[error.start]:02x}") from None
    try:
        _check_extent(yaml.parse(text, Loader=yaml.SafeLoader))
        return yaml.load(text, Loader=_loader())
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML: {error}") from error


def _check_extent(events: Iterable[Any]) -> None:
    """Raise ValueError if the values are nested too deeply or too many, with aliases written out."""
    import yaml

    known: dict[str, tuple[int, int]] = {}  # number of values and levels of each anchor
    open_ones: list[list] = [["", 0, 0]]  # anchor, values and levels so far
    for event in events:
        line = event.start_mark.line + 1
        if isinstance(event, yaml.CollectionStartEvent):
            open_ones.append([event.anchor, 1, 0])
            values, levels = 0, 0
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, values, levels = open_ones.pop()
            levels += 1
            known[anchor] = values, levels
        elif isinstance(event, yaml.ScalarEvent):
            values, levels = 1, 0
            known[event.anchor] = 1, 0
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in known:
                raise ValueError(f"line {line}: the alias *{event.anchor} stands for nothing, or for itself")
            values, levels = known[event.anchor]
        else:
            continue
        open_ones[-1][1] += values
        open_ones[-1][2] = max(open_ones[-1][2], levels)
        if len(open_ones) + open_ones[-1][2] > _DEEPEST + 1:
            raise ValueError(f"line {line} is nested more than {_DEEPEST} levels deep")
        if sum(count for _, count, _ in open_ones) > _MOST_VALUES:
            raise ValueError(f"line {line}: more than {_MOST_VALUES} values, with aliases written out")


def _loader() -> Any:
    """Return PyYAML's loader of plain values, which also refuses a key that comes twice."""
    import yaml

    class StrictLoader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict:
            seen = set()
            for key, _ in node.value:
                name = (key.tag, str(key.value))
                if name in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"{key.value!r} comes twice", key.start_mark
                    )
                seen.add(name)
            return super().construct_mapping(node, deep=deep)

    return StrictLoader
