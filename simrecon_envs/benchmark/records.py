"""`Records`: finished pieces of work on disk, so that a killed run can continue."""

import hashlib
import json
from pathlib import Path
from typing import Any

from simrecon_envs.files import write_json


class Records:
    """One JSON file per piece of work, in a hidden folder beside the result's file."""

    def __init__(self, out: Path) -> None:
        """Use the folder that belongs to the result `out`; nothing is created yet."""
        self.folder = out.with_name(f".{out.name}.records")

    def get(self, key: Any) -> dict | None:
        """Return the record of a piece of work; None where it is absent or truncated. `key` is JSON."""
        try:
            return json.loads(self._file(key).read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError):
            return None

    def put(self, key: Any, record: dict) -> None:
        """Store the record of a piece of work."""
        write_json(self._file(key), record)

    def clear(self) -> None:
        """Remove all records; to be called when the result is written."""
        if self.folder.is_dir():
            for file in self.folder.iterdir():
                file.unlink()
            self.folder.rmdir()

    def _file(self, key: Any) -> Path:
        text = json.dumps(key, sort_keys=True)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"
