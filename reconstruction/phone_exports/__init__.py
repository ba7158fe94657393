"""Read exports of phone apps: images, and poses by image name."""
