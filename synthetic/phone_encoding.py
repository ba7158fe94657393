"""Encode films as phones do: codec, bit depth, high dynamic range, time stamps, rotation.

High dynamic range is written by the formulas of ITU-R BT.2100, with the white of standard films at 203 cd/m2 (BT.2408),
independently of how `reconstruction.frames` reads it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

_TICKS_PER_S = 90000
_BT709_TO_BT2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
_BT2020_LUMA = np.array([0.2627, 0.6780, 0.0593])
_WHITE_NITS, _PEAK_NITS, _HLG_GAMMA = 203.0, 1000.0, 1.2
_TRANSFER = {"sdr": 1, "pq": 16, "hlg": 18}  # H.273 code points; 1: BT.709


@dataclass(frozen=True)
class Encoding:
    """An encoder of PyAV with its pixel format and colors."""

    encoder: str
    pixel_format: str
    suffix: str = ".mp4"
    transfer: str = "sdr"  # "sdr", "hlg" or "pq"; the last two with the primaries of BT.2020
    options: dict[str, str] = field(default_factory=dict)

    @property
    def full_range(self) -> bool:
        """Whether black is 0 and white the largest value."""
        return "yuvj" in self.pixel_format


_X265 = {"preset": "veryfast", "crf": "20", "x265-params": "log-level=error:pools=none:frame-threads=1"}
_X264 = {"preset": "veryfast", "crf": "20", "threads": "1"}
ENCODINGS: dict[str, Encoding] = {
    "h264": Encoding("libx264", "yuv420p", options=_X264),
    "h264_full_range": Encoding("libx264", "yuvj420p", options=_X264),
    "hevc": Encoding("libx265", "yuv420p", ".mov", options=_X265),
    "hevc_10": Encoding("libx265", "yuv420p10le", ".mov", options=_X265),
    "hevc_10_hlg": Encoding("libx265", "yuv420p10le", ".mov", "hlg", _X265),
    "hevc_10_pq": Encoding("libx265", "yuv420p10le", ".mov", "pq", _X265),
    "prores": Encoding("prores_ks", "yuv422p10le", ".mov"),
    "prores_hlg": Encoding("prores_ks", "yuv422p10le", ".mov", "hlg"),
    "vp9": Encoding("libvpx-vp9", "yuv420p", ".webm", options={"crf": "24", "b": "0", "cpu-used": "6"}),
    "av1_10": Encoding("libsvtav1", "yuv420p10le", ".mp4", options={"preset": "10", "crf": "26"}),
    "mjpeg": Encoding("mjpeg", "yuvj420p", ".mov", options={"qmin": "3", "qmax": "3"}),
}
"""Encodings that phones and their apps write, by name."""


def write_phone_video(
    path: Path, images: Iterable[np.ndarray], times_s: Sequence[float], encoding: Encoding, *, rotation_deg: int = 0
) -> None:  # fmt: skip
    """Encode RGB images (h, w, 3) uint8 at the given times.

    Args:
        path: file to write.
        images: frames as stored; those of a portrait film lie on their side.
        times_s: seconds, one per frame, increasing.
        encoding: one of `ENCODINGS`, or another.
        rotation_deg: counter-clockwise turn that players must apply, written as the track's display matrix.
    """
    import av

    with av.open(str(path), "w") as container:
        stream = None
        for image, time_s in zip(images, times_s):
            if stream is None:
                fps = 1 / float(np.median(np.diff(times_s)))
                stream = container.add_stream(
                    encoding.encoder, rate=Fraction(fps).limit_denominator(1001), options=encoding.options
                )
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = encoding.pixel_format
                context = stream.codec_context
                context.time_base = Fraction(1, _TICKS_PER_S)
                context.color_range = 2 if encoding.full_range else 1
                context.color_trc = _TRANSFER[encoding.transfer]
                context.color_primaries, context.colorspace = (1, 1) if encoding.transfer == "sdr" else (9, 9)
                if rotation_deg:
                    stream.set_display_rotation(rotation_deg)
            frame = _as_yuv(image, encoding)
            frame.pts, frame.time_base = round(time_s * _TICKS_PER_S), Fraction(1, _TICKS_PER_S)
            container.mux(stream.encode(frame))
        container.mux(stream.encode() if stream else [])


def _as_yuv(image: np.ndarray, encoding: Encoding):
    import av
    from av.video.reformatter import Colorspace, Interpolation

    if encoding.transfer == "sdr":
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        # Decoders of motion JPEG assume the matrix of BT.601, whatever the file says.
        matrix = Colorspace.ITU601 if encoding.encoder == "mjpeg" else Colorspace.ITU709
    else:
        signal = to_high_dynamic_range(image, encoding.transfer)
        frame = av.VideoFrame.from_ndarray(np.round(65535 * signal).astype(np.uint16), format="rgb48le")
        matrix = Colorspace.BT2020
    limits = 2 if encoding.full_range else 1
    exact = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
    yuv = frame.reformat(
        format=encoding.pixel_format, dst_colorspace=matrix, dst_color_range=limits, interpolation=exact
    )
    yuv.color_trc = _TRANSFER[encoding.transfer]
    yuv.color_primaries = 1 if encoding.transfer == "sdr" else 9
    return yuv


def to_high_dynamic_range(image: np.ndarray, transfer: str) -> np.ndarray:
    """Convert sRGB uint8 (h, w, 3) to the signal (0 to 1) of "pq" or "hlg" with the primaries of BT.2020."""
    value = np.asarray(image, np.float64) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    nits = _WHITE_NITS * linear @ _BT709_TO_BT2020.T
    return pq_signal(nits) if transfer == "pq" else hlg_signal(nits)


def pq_signal(nits: np.ndarray) -> np.ndarray:
    """Return the PQ signal of displayed light, cd/m2 (BT.2100, table 4)."""
    power = np.clip(nits / 10000, 0, 1) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


def hlg_signal(nits: np.ndarray) -> np.ndarray:
    """Return the HLG signal of displayed light (h, w, 3), cd/m2, on a display of 1000 cd/m2 (BT.2100, table 5)."""
    luminance = np.maximum(nits @ _BT2020_LUMA / _PEAK_NITS, 1e-9)[..., None]
    scene = np.clip(nits / _PEAK_NITS * luminance ** ((1 - _HLG_GAMMA) / _HLG_GAMMA), 0, 1)
    low = np.sqrt(3 * scene)
    high = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, low, high)
