"""Corrections in the page: acts become entries of the overrides file, Apply runs the stages that they change."""
