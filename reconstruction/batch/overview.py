"""Keep the tables and the page of a running batch up to date."""

import time

from reconstruction.batch.journal import Journal
from reconstruction.batch.listing import Listing
from reconstruction.batch.page import write_pages
from reconstruction.batch.results import Results
from registry import SceneRegistry

_EVERY_S = 30.0
_SHARE = 0.02  # of the time may go into writing


class Overview:
    """Writes `results.csv`, `results.parquet`, `objects.*` and `index.html` of a batch."""

    def __init__(self, journal: Journal, listing: Listing, registry: SceneRegistry) -> None:
        self._journal, self._listing = journal, listing
        self._results = Results(journal.path.parent, registry)
        self._next = time.monotonic() + _EVERY_S

    def refresh(self) -> None:
        """Write all if that is some time ago."""
        began = time.monotonic()
        if began >= self._next:
            self.write()
            ended = time.monotonic()
            self._next = ended + max(_EVERY_S, (ended - began) / _SHARE)

    def write(self) -> list[str]:
        """Write all; return notes about what could not be written.

        Raises:
            OSError: the disk is full or not writable.
        """
        scenes, objects = self._results.tables(self._listing.rows, self._journal.states())
        notes = self._results.write(scenes, objects)
        write_pages(self._journal.path.parent, self._listing.name, scenes)
        return notes
