"""What leaves the site: the report and the registered data set, made from the recorded evidence."""
