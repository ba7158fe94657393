"""Check of a film before its reconstruction: sharpness, parallax, overlap, exposure, directions, marker.

Not a stage: it reads the video, and its result is text. `simrecon check` prints it, and `simrecon reconstruct` where
the poses stage had trouble.
"""

from reconstruction.precheck.judge import FilmReport, Line, judge_film
from reconstruction.precheck.measure import Figures, measure_film
from reconstruction.precheck.sampling import Film, sample_film

__all__ = ["Figures", "Film", "FilmReport", "Line", "judge_film", "measure_film", "sample_film"]
