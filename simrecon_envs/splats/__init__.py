"""Draw a scene's 2D Gaussians as the pictures of its environment: `gym.make(..., renderer="splats")`.

`scene` reads a bundle's Gaussians, `kernels` and `rasterizer` draw them, `compositing` puts them before SAPIEN's
picture of meshes and robot, `cameras` does so for every camera of an environment. Only environments with this renderer
import the package's modules, and Numba with them. See `docs/splats.md`.
"""
