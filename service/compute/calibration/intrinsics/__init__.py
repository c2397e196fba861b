"""The camera's intrinsics from views of a board, their quality, and whether they still hold."""
