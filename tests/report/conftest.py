"""Fixtures: the report pages of a small reconstructed room."""

import pytest
from rooms.small_room import reconstructed

__all__ = ["reconstructed"]


@pytest.fixture(scope="session")
def page(reconstructed) -> str:
    """The page without ground truth."""
    return (reconstructed.home / "page.html").read_text()


@pytest.fixture(scope="session")
def page_with_truth(reconstructed) -> str:
    """The page with ground truth."""
    return (reconstructed.home / "page_with_truth.html").read_text()
