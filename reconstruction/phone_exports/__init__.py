"""Exports of phone apps, which hold images and poses, and poses by the names of images."""
