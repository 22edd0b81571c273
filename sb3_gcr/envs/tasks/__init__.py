"""The tasks, one robot a file; ``catalogue`` lists them."""
