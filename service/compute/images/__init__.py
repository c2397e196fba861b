"""Photographs, read and developed, and what belongs to each of their pixels: rays, depth, normals, masks, crops."""
