"""The benchmark of feature matching: results of methods on the pairs of a data set, as files, tables and plots."""
