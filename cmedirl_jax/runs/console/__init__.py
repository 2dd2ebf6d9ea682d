"""The terminal: progress, signals, standard streams, and the compilation cache."""
