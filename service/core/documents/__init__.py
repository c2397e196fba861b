"""The texts of generated documents, made from the models themselves."""
