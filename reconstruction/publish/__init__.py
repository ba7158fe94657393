"""Write a finished run as a scene bundle and publish it in the registry."""

from reconstruction.publish.write import publish_scene

__all__ = ["publish_scene"]
