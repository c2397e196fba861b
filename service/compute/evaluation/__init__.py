"""How good a registration is: errors at control spheres, loop closures and the error budget."""
