"""Parse the option `--scale`: a length that the user knows."""

import math
import re
from dataclasses import dataclass

from registry.errors import UsageError

_HELP = """Write one of
  --scale camera-height=1.5                 the camera was 1.5 m above the floor (median over the video)
  --scale distance:40,100,200,300,210=1.2   in video frame 40, pixels (100,200) and (300,210) are 1.2 m apart
  --scale object:3.height=0.74              object 3 (see `simrecon show`) is 0.74 m high"""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


@dataclass(frozen=True)
class ScaleRequest:
    """A known length in the scene."""

    kind: str  # "camera-height" | "distance" | "object"
    value_m: float
    frame: int = -1  # "distance": decoded video frame number
    pixels: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # "distance": x1, y1, x2, y2
    object_id: int = 0  # "object"


def parse_scale(text: str) -> ScaleRequest:
    """Parse the text of `--scale`.

    Raises:
        UsageError: the text is malformed; the message shows the possible forms.
    """
    subject, equals, value = text.strip().partition("=")
    subject = subject.strip()
    if not equals:
        raise UsageError(f"--scale {text!r}: there is no '=' with a length in metres. {_HELP}")
    length_m = _length(text, value.strip())
    if subject == "camera-height":
        if not 0.05 <= length_m <= 20:
            raise UsageError(
                f"--scale {text!r}: a camera height must lie between 0.05 and 20. The unit is metres. {_HELP}"
            )
        return ScaleRequest("camera-height", length_m)
    if subject.startswith("distance:"):
        parts = [p.strip() for p in subject[len("distance:") :].split(",")]
        if len(parts) != 5 or not all(re.fullmatch(_NUMBER, p) for p in parts) or not parts[0].isdigit():
            raise UsageError(f"--scale {text!r}: expected distance:FRAME,X1,Y1,X2,Y2=METRES. {_HELP}")
        x1, y1, x2, y2 = (float(p) for p in parts[1:])
        if math.hypot(x2 - x1, y2 - y1) < 2:
            raise UsageError(
                f"--scale {text!r}: the two pixels coincide; choose two that are far apart. {_HELP}"
            )
        return ScaleRequest("distance", length_m, frame=int(parts[0]), pixels=(x1, y1, x2, y2))
    if match := re.fullmatch(r"object:(\d+)\.height", subject):
        return ScaleRequest("object", length_m, object_id=int(match.group(1)))
    raise UsageError(f"--scale {text!r}: {subject!r} is not one of the possible forms. {_HELP}")


def _length(text: str, value: str) -> float:
    """Parse a positive length in metres, with or without the unit m; `text` is for the error."""
    number = value[:-1].strip() if value.endswith("m") and not value.endswith(("cm", "mm")) else value
    if not re.fullmatch(_NUMBER, number) or not math.isfinite(float(number)) or float(number) <= 0:
        hint = " (centimetres? 74 cm is 0.74)" if value.endswith(("cm", "mm")) else ""
        raise UsageError(f"--scale {text!r}: {value!r} is not a positive length in metres{hint}. {_HELP}")
    return float(number)
