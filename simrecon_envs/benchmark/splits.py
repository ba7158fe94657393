"""Train/test split and episode seeds by hash of names, so they do not change when scenes or objects are added."""

import hashlib

SIDES = ("train", "test")


def side_of(name: str, test_share: float) -> str:
    """Return "train" or "test" for a scene or an object. A share of 0.2 splits scenes as `SimRecon/Multi-v0` does."""
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
    return "test" if number % 100 < round(100 * test_share) else "train"


def episode_seed(seed: int, task: str, number: int) -> int:
    """Return the seed of a task's episode from the suite's seed, the task's name and the episode's number."""
    text = f"{seed}/{task}/{number}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") % 2**31
