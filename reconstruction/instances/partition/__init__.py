"""Learned partition: superpoint graph, affinities by a graph network, multicut, and a choice of scored proposals."""

from reconstruction.instances.partition.cut import cut_by_partition

__all__ = ["cut_by_partition"]
