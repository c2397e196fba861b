"""Jobs on meshes, and on the spheres in them and in photographs of the layout."""
