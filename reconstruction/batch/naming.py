"""Scene ids from file names: valid, unique, and the same in every run of a batch."""

import hashlib
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path

from reconstruction.batch.rows import AnyPath

_LONGEST = 64


def id_of_name(name: str) -> str:
    """Return a valid scene id for a name: small ASCII letters, digits and underscores.

    Accents are dropped. A name without any Latin letter or digit gives `film_` and 8 hex digits of its SHA-256.
    """
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    found = re.sub(r"[^a-z0-9]+", "_", ascii_only.lower()).strip("_")[: _LONGEST - 8].strip("_")
    if found:
        return found
    return f"film_{hashlib.sha256(name.encode('utf-8', 'surrogateescape')).hexdigest()[:8]}"


def assign_ids(
    videos: Sequence[AnyPath], taken: Mapping[str, AnyPath], known: Mapping[str, str] | None = None
) -> dict[AnyPath, str]:
    """Return a scene id for each video: that of an earlier run, or one from its file name with `_2`, `_3` … if taken.

    Args:
        videos: paths without repeats, in order.
        taken: ids that rows of the list give.
        known: ids of an earlier run of the batch, by path or address.
    """
    known = known or {}
    ids: dict[AnyPath, str] = {}
    used = set(taken)
    for video in videos:
        before = known.get(str(video))
        if before is not None and before not in used:
            ids[video] = before
            used.add(before)
    for video in videos:
        if video in ids:
            continue
        base = id_of_name(video.name if isinstance(video, Path) and video.is_dir() else video.stem)
        number, found = 1, base
        while found in used:
            number += 1
            found = f"{base}_{number}"
        ids[video] = found
        used.add(found)
    return {video: ids[video] for video in videos}
