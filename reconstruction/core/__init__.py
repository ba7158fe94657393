"""Shared basics of all stages: artifact types, cameras, progress, plugins, profiling, mesh graphs, mesh rasterizer."""
