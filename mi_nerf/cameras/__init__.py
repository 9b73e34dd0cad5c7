"""A pixel becomes a ray: poses, pinhole cameras, normalised device coordinates, paths."""
