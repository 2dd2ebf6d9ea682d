"""Training loops of other libraries, each run by the Python of an environment of its own.

All take one update of the same sizes per environment step: networks (64, 64), batch 32, a replay of
12,000, Ornstein-Uhlenbeck or Gaussian noise, learning from step 200 on.
"""
