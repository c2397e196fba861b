"""Planning of viewpoints and motions, and the predicted quality of the data so far."""
