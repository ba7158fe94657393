"""Engines: places that run the jobs of a batch. Another engine is a class with the methods of `Engine`."""

from reconstruction.batch.engines.base import Engine, Resources, load_engine

__all__ = ["Engine", "Resources", "load_engine"]
