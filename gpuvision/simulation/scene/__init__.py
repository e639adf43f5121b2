"""Scenes: triangles with materials, ray queries, visibility, reflectance models."""
