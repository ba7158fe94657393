"""What every stage needs: artifact types, cameras, progress, compiled kernels, mesh graphs, the mesh rasterizer."""
