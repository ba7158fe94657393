"""Correction of a scene in the page: acts become entries of its overrides file, Apply runs the stages that they change."""
