"""Verification of the evidence, here and by the stand-alone verifier of a bundle."""
