"""Films as phones store them: codecs, bit depths, high dynamic range."""

import numpy as np
import pytest
from notes import Notes

from reconstruction.frames import FramesConfig, load_frames
from reconstruction.frames.tone_mapping import HLG, PQ, to_standard_range
from synthetic.phone_encoding import ENCODINGS, hlg_signal, pq_signal, write_phone_video
from synthetic.videos import standard_film

pytestmark = pytest.mark.stage
_TIMES = [k / 12 for k in range(24)]


@pytest.mark.parametrize("name", sorted(ENCODINGS))
def test_every_encoding_gives_the_colors_that_were_filmed(tmp_path, name):
    film, encoding = standard_film()[:24], ENCODINGS[name]
    path = tmp_path / f"film{encoding.suffix}"
    write_phone_video(path, film, _TIMES, encoding)
    notes = Notes()
    found = load_frames(path, FramesConfig(), progress=notes)
    off = found.images.astype(int) - film[found.indices]
    assert np.abs(off).mean() < 5, "of which codecs make 2 to 4; flat high dynamic range is 11 to 25 off"
    assert np.abs(off.mean((0, 1, 2))).max() < 1.2, "rounded, not truncated"
    assert any("high dynamic range" in n for n in notes.notes) == (encoding.transfer != "sdr")


@pytest.mark.parametrize(("code", "signal"), [(PQ, pq_signal), (HLG, hlg_signal)])
def test_light_is_shown_as_the_standards_say(code, signal):
    nits = np.repeat(np.array([[0.0, 20.0, 203.0, 600.0]]).T, 3, axis=1)[None]
    shown = to_standard_range(np.round(65535 * signal(nits)).astype(np.uint16), code)
    middle = round(255 * (1.055 * (20 / 203) ** (1 / 2.4) - 0.055))
    assert np.abs(shown[0, :, 1].astype(int) - [0, middle, 255, 255]).max() <= 1


@pytest.mark.parametrize("code", [PQ, HLG])
def test_colors_are_those_of_libswscale(code):
    """It converts the same way, but spends seconds on a table."""
    import av
    from av.video.reformatter import VideoReformatter

    from synthetic.phone_encoding import to_high_dynamic_range

    colors = np.random.default_rng(0).integers(0, 256, (48, 48, 3)).astype(np.uint8)
    signal = np.round(65535 * to_high_dynamic_range(colors, "pq" if code == PQ else "hlg")).astype(np.uint16)
    frame = av.VideoFrame.from_ndarray(signal, format="rgb48le")
    frame.color_trc, frame.color_primaries = code, 9
    theirs = VideoReformatter().reformat(frame, format="rgb24", dst_color_trc=13, dst_color_primaries=1)
    ours = to_standard_range(signal, code).astype(int)
    assert np.abs(ours - colors).max() <= 2
    # Theirs compresses colors at the edge of the gamut.
    assert np.quantile(np.abs(ours - theirs.to_ndarray()), 0.5) <= 3
