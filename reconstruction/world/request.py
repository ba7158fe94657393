"""What the user says about metres: the text of `--scale`, parsed."""

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
    """One statement of the user about a length in the scene."""

    kind: str  # "camera-height" | "distance" | "object"
    value_m: float
    frame: int = -1  # "distance": decoded video frame number
    pixels: tuple[float, float, float, float] = (
        0.0,
        0.0,
        0.0,
        0.0,
    )  # "distance": x1, y1, x2, y2 in the video
    object_id: int = 0  # "object"


def parse_scale(text: str) -> ScaleRequest:
    """Parse the text of `--scale`.

    Raises:
        UsageError: says what is wrong with it and shows what can be written.
    """
    subject, equals, value = text.strip().partition("=")
    subject = subject.strip()
    if not equals:
        raise UsageError(f"--scale {text!r}: there is no '=' with a length in metres. {_HELP}")
    length_m = _length(text, value.strip())
    if subject == "camera-height":
        if not 0.05 <= length_m <= 20:
            raise UsageError(
                f"--scale {text!r}: a camera {length_m:g} m above the floor? The unit is metres. {_HELP}"
            )
        return ScaleRequest("camera-height", length_m)
    if subject.startswith("distance:"):
        parts = [p.strip() for p in subject[len("distance:") :].split(",")]
        if len(parts) != 5 or not all(re.fullmatch(_NUMBER, p) for p in parts) or not parts[0].isdigit():
            raise UsageError(f"--scale {text!r}: expected distance:FRAME,X1,Y1,X2,Y2=METRES. {_HELP}")
        x1, y1, x2, y2 = (float(p) for p in parts[1:])
        if math.hypot(x2 - x1, y2 - y1) < 2:
            raise UsageError(
                f"--scale {text!r}: the two pixels are the same; choose two that are far apart. {_HELP}"
            )
        return ScaleRequest("distance", length_m, frame=int(parts[0]), pixels=(x1, y1, x2, y2))
    if match := re.fullmatch(r"object:(\d+)\.height", subject):
        return ScaleRequest("object", length_m, object_id=int(match.group(1)))
    raise UsageError(f"--scale {text!r}: nothing is known about {subject!r}. {_HELP}")


def _length(text: str, value: str) -> float:
    number = value[:-1].strip() if value.endswith("m") and not value.endswith(("cm", "mm")) else value
    if not re.fullmatch(_NUMBER, number) or not math.isfinite(float(number)) or float(number) <= 0:
        hint = " (centimetres? 74 cm is 0.74)" if value.endswith(("cm", "mm")) else ""
        raise UsageError(f"--scale {text!r}: {value!r} is not a positive length in metres{hint}. {_HELP}")
    return float(number)
