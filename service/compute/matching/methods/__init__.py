"""Methods of feature matching, one file each."""
