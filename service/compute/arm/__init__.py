"""The arm: forward and inverse kinematics, and the correction of its systematic errors."""
