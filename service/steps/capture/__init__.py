"""Taking photographs, by the robot or by hand: plans, motion, settings, what each image is worth."""
