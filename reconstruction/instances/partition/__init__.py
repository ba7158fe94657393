"""The learned cut: superpoints, affinities of their borders, unaries, and one multicut (Keuper et al., ICCV 2015)."""

from reconstruction.instances.partition.cut import cut_by_partition

__all__ = ["cut_by_partition"]
