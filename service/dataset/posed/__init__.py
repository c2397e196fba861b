"""The data set that every export format is written from: posed images, what belongs to their pixels, and the mesh."""
