"""What leaves the house: the report and the registered data set, made from what was recorded."""
