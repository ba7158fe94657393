"""Which side of a split something is on: by the hash of its name, so that it keeps its side when others come or go."""

import hashlib

SIDES = ("train", "test")


def side_of(name: str, test_share: float) -> str:
    """Return "train" or "test"; with a share of 0.2 scenes are split as in `SimRecon/Multi-v0`."""
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
    return "test" if number % 100 < round(100 * test_share) else "train"


def episode_seed(seed: int, task: str, number: int) -> int:
    """Return the seed of a task's episode: of the suite's seed, the task's name and the episode's number."""
    text = f"{seed}/{task}/{number}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") % 2**31
