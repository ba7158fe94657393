"""What was done so far, kept beside the result that is on its way: a run that was killed goes on with it."""

import hashlib
import json
from pathlib import Path
from typing import Any

from simrecon_envs.files import write_json


class Records:
    """One file a piece of work, in a folder beside the result's file."""

    def __init__(self, out: Path) -> None:
        self.folder = out.with_name(f".{out.name}.records")

    def get(self, key: Any) -> dict | None:
        """Return the record of a piece of work; None where it is absent or was cut off."""
        try:
            return json.loads(self._file(key).read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError):
            return None

    def put(self, key: Any, record: dict) -> None:
        """Keep a record."""
        write_json(self._file(key), record)

    def clear(self) -> None:
        """Remove all records: the result is written."""
        if self.folder.is_dir():
            for file in self.folder.iterdir():
                file.unlink()
            self.folder.rmdir()

    def _file(self, key: Any) -> Path:
        text = json.dumps(key, sort_keys=True)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"
