"""The benchmark of reconstruction: methods run on an exported data set, their meshes scored against its truth."""
