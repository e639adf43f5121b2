"""Range imaging: read the light, triangulate, assemble."""
