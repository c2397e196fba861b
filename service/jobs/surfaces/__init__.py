"""Kinds of jobs on surfaces and on the spheres in them."""
