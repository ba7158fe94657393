"""Judge the figures of a film: one line of verdict and one of advice for each property."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.precheck.limits import FAIL_LIMITS, HIGH, MIN_VIEWS, WARN_LIMITS
from reconstruction.precheck.measure import Figures, measure_film
from reconstruction.precheck.sampling import Film, sample_film

Status = Literal["pass", "warn", "fail"]
_NEAR = 1.5  # factor from a limit within which a figure warns
_SHORT_SIDE_PX = 480  # below, small things have few pixels; the bench captures have 480
_MAX_DRIFT_STOPS = 2.0  # gray values of one point then differ by a factor of 1.9


@dataclass(frozen=True)
class Line:
    """The verdict on one property of a film."""

    name: str
    status: Status
    text: str
    advice: str = ""
    frames: tuple[int, ...] = ()  # rows of the sampled frames that show the trouble

    def as_text(self) -> list[str]:
        """Return one line of text, and a second one with the advice."""
        advice = [f"      {'':<9} {self.advice}"] if self.advice else []
        return [f"{self.status}  {self.name:<9} {self.text}", *advice]


@dataclass(frozen=True)
class FilmReport:
    """The lines of all properties, worst figures included."""

    lines: list[Line]
    figures: dict[str, float]
    film: Film = field(repr=False)
    measured: Figures = field(repr=False)

    @property
    def fails(self) -> bool:
        """Tell whether the film is unlikely to be reconstructed."""
        return any(line.status == "fail" for line in self.lines)

    def text(self) -> list[str]:
        """Return the lines as text; advice follows indented."""
        return [text for line in self.lines for text in line.as_text()]

    def to_json(self) -> dict[str, Any]:
        """Return all lines, figures and the map of directions."""
        coverage = self.measured.coverage
        return {
            "schema": "simrecon.check/1",
            "file": self.film.file,
            "fine": not self.fails,
            "lines": [{k: v for k, v in asdict(line).items() if k != "frames"} for line in self.lines],
            "figures": self.figures,
            "directions": {"step_deg": 10, "frames_by_pitch_and_yaw": coverage.seen.tolist()},
            "markers": list(self.measured.markers),
        }


def judge_film(video: Path, progress: Progress = NO_PROGRESS) -> FilmReport:
    """Sample, measure and judge a video, a folder of images, or an export of a phone app.

    Raises:
        UsageError: there is no such file or folder.
        InputError: nothing can be decoded.
    """
    film = sample_film(video, progress)
    measured = measure_film(film, progress)
    v = measured.judged()
    lines = [_length(film, measured), _sharp(measured, v), _texture(measured, v), _overlap(measured, v)]
    lines += [_parallax(measured, v), _exposure(measured, v), _directions(measured), _floor(measured)]
    return FilmReport([*lines, _marker(measured)], v, film, measured)


def _status(name: str, value: float) -> Status:
    if name in WARN_LIMITS:
        limit = WARN_LIMITS[name]
        return "warn" if (value > limit if name in HIGH else value < limit) else "pass"
    limit = FAIL_LIMITS[name]
    low, high = (value, limit) if name not in HIGH else (limit, value)
    return "fail" if low < high else "warn" if low < high * _NEAR else "pass"


def _worst(*statuses: Status) -> Status:
    return max(statuses, key=("pass", "warn", "fail").index)


def _advice(status: Status, text: str) -> str:
    return "" if status == "pass" else text


def _rows(values: np.ndarray, most: int = 4) -> tuple[int, ...]:
    return tuple(int(r) for r in sorted(np.argsort(values, kind="stable")[:most]))


def _length(film: Film, m: Figures) -> Line:
    length = f"{film.duration_s:.1f} s, {film.fps:.0f} frames/s" if film.fps else "images"
    status: Status = "fail" if m.views < MIN_VIEWS else "pass"
    if status == "pass" and (min(film.width, film.height) < _SHORT_SIDE_PX or film.damage):
        status = "warn"
    text = f"{film.frame_count} frames, {length}, {film.width}x{film.height}, {m.views} different views"
    text += f"; {film.damage}" if film.damage else ""
    advice = "Film for 10 to 60 s while walking, at 640x480 or more."
    return Line("length", status, text, _advice(status, advice))


def _sharp(m: Figures, v: dict[str, float]) -> Line:
    status = _status("blur_px", v["blur_px"])
    text = f"edges are blurred by {v['blur_px']:.1f} px (limit {WARN_LIMITS['blur_px']:.1f}, in frames of 480 px)"
    advice = "Move slowly, use more light, tap to focus."
    return Line("sharp", status, text, _advice(status, advice), _rows(-m.blur_px))


def _texture(m: Figures, v: dict[str, float]) -> Line:
    status = _worst(_status("matches", v["matches"]), _status("spread", v["spread"]))
    text = f"{v['matches']:.0f} features per frame match, over {100 * v['spread']:.0f} % of the frame"
    advice = "Keep things with texture in view, not blank walls; stay 1 to 3 m away."
    return Line("texture", status, text, _advice(status, advice), _rows(m.spread))


def _overlap(m: Figures, v: dict[str, float]) -> Line:
    status: Status = _status("connected", v["connected"])
    if status == "warn" and v["connected"] > 0.95:
        status = "pass"
    text = f"{100 * v['connected']:.0f} % of the frames are connected by matches"
    apart = np.setdiff1d(np.arange(len(m.matches)), m.coverage.rows)
    advice = "Turn slowly and film without cuts, so that each view shares half of the one before."
    return Line("overlap", status, text, _advice(status, advice), tuple(int(r) for r in apart[:4]))


def _parallax(m: Figures, v: dict[str, float]) -> Line:
    status = _status("parallax_deg", v["parallax_deg"])
    text = f"{v['parallax_deg']:.1f} degrees of parallax beyond rotation (limit {FAIL_LIMITS['parallax_deg']:.1f})"
    advice = "Walk sideways or around the things; turning on the spot shows no depth."
    return Line("parallax", status, text, _advice(status, advice), _rows(m.parallax_deg))


def _exposure(m: Figures, v: dict[str, float]) -> Line:
    status = _worst(_status("bright", v["bright"]), _status("clipped", v["clipped"]))
    if v["drift_stops"] > _MAX_DRIFT_STOPS:
        status = _worst(status, "warn")
    text = f"bright parts at {v['bright']:.0f} of 255, {100 * v['clipped']:.0f} % clipped, "
    text += f"exposure drifts by {v['drift_stops']:.1f} stops"
    dark = v["bright"] < WARN_LIMITS["bright"]
    advice = "Turn on the light." if dark else "Lock the exposure; avoid windows in view."
    rows = _rows(m.exposure.bright if dark else -m.exposure.clipped)
    return Line("exposure", status, text, _advice(status, advice), rows)


def _directions(m: Figures) -> Line:
    seen = m.coverage.seen.sum(axis=0)
    marks = "".join("#" if c >= 5 else "+" if c else "." for c in seen[::3] + seen[1::3] + seen[2::3])
    text = f"views span {m.coverage.yaw_deg:.0f} degrees of yaw [{marks}]"
    return Line("coverage", "pass", text)


def _floor(m: Figures) -> Line:
    lower = m.coverage.lower_edge_deg
    if lower is None:
        return Line(
            "floor", "warn", "the vertical could not be found", "Keep some floor and upright edges in view."
        )
    status: Status = "pass" if m.coverage.sees_floor else "warn"
    text = (
        f"the frames' lower edge is {abs(lower):.0f} degrees {'below' if lower < 0 else 'above'} the horizon"
    )
    return Line("floor", status, text, _advice(status, "Tilt the camera down, so that the floor is in view."))


def _marker(m: Figures) -> Line:
    if m.markers:
        ids = ", ".join(map(str, m.markers[:5]))
        return Line(
            "marker", "pass", f"AprilTag {ids}: give its side with --marker-size METRES for a certain scale"
        )
    return Line("marker", "pass", "no AprilTag: the scale is a guess, see `simrecon marker`")
