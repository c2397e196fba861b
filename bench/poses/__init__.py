"""Camera poses from images, against ground truth and against COLMAP."""
