"""Places that a fused surface lacks because they are steep: searched for along the normals of a closed guess."""
