"""One cell of a run: all seeds of a method with one number of demonstrations."""
