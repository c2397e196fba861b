"""The registration as a least-squares problem: residuals, start, normal equations, variance components."""
