"""A small reconstructed room, whose corrections are tested."""

from rooms.small_room import reconstructed

__all__ = ["reconstructed"]
