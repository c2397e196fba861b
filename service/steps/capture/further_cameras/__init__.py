"""The further cameras of a rig, which are not on the arm: their images, and the jobs that look at them."""
